"""The convolutions that all parts are built of, and what makes them fast once they are trained."""

import copy
from typing import Any

import torch
from torch import fx, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from egovm.memory import keep_freed_memory


def convolution(before: int, after: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, batch norm and ReLU; cells become stride times as wide."""
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU(inplace=True)
    )


def joint(before: int, after: int) -> nn.Sequential:
    """Other features of each cell, normalized, to be added to those of another branch."""
    return nn.Sequential(nn.Conv2d(before, after, 1, bias=False), nn.BatchNorm2d(after))


def deployed(network: nn.Module, precision: torch.dtype | None = None) -> nn.Module:
    """A copy that runs faster and gives the same: in eval mode, batch norms folded into the convolutions before them,
    weights laid out by pixel (channels_last).

    precision: in which the BEV side computes, None: that of the weights. What comes after it stays in float32. From
    here on the process keeps memory that it frees (``egovm.memory``).
    """
    keep_freed_memory()
    found = copy.deepcopy(network).eval()
    for module in list(found.modules()):
        if isinstance(module, nn.Sequential):
            _fold(module)
        if isinstance(backbone := getattr(module, "backbone", None), nn.Module):
            fold_traced(backbone)
    if precision is not None:
        for module in found.modules():
            if hasattr(module, "precision"):
                _convert(module, precision)
    return found.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def native_precision() -> torch.dtype | None:
    """The shorter type in which this processor multiplies twice as many numbers at once; None where it has none."""
    return torch.bfloat16 if torch.cpu.get_capabilities().get("avx512_bf16", False) else None


def fold_traced(network: nn.Module) -> None:
    """Fold the batch norms of a network whose order of calls is known only from tracing it.

    Where it cannot be traced it stays as it is.
    """
    try:
        graph = _Calls().trace(network)
    except Exception:  # what tracing meets has no common kind
        return
    modules = dict(network.named_modules())
    for node in graph.nodes:
        norm = modules[node.target] if node.op == "call_module" else None
        if not isinstance(norm, nn.BatchNorm2d) or node.args[0].op != "call_module":
            continue
        before = modules[node.args[0].target]
        if isinstance(before, nn.Conv2d) and len(node.args[0].users) == 1:
            network.set_submodule(node.args[0].target, fuse_conv_bn_eval(before, norm))
            network.set_submodule(node.target, _after(norm))


class _Calls(fx.Tracer):
    """Sees what timm makes of a batch norm, one with an activation in it, as one call."""

    def is_leaf_module(self, module: nn.Module, name: str) -> bool:
        return isinstance(module, nn.BatchNorm2d) or super().is_leaf_module(module, name)


def _after(norm: nn.BatchNorm2d) -> nn.Module:
    """What is left of a batch norm that is folded: the activation that timm's have."""
    return norm.act if hasattr(norm, "act") else nn.Identity()  # type: ignore[return-value]


def _fold(chain: nn.Sequential) -> None:
    """Put each batch norm right after a convolution into it."""
    for index in range(1, len(chain)):
        before, norm = chain[index - 1], chain[index]
        if isinstance(before, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            chain[index - 1], chain[index] = fuse_conv_bn_eval(before, norm), nn.Identity()


def _convert(network: Any, precision: torch.dtype) -> None:
    """Tell it the type, and convert the weights that autocast would convert at each call."""
    network.precision = precision
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            module.to(precision)
