"""Patches of dot products between map embeddings and BEV features: numba on the CPU, torch elsewhere and in exports.

An operator of torch's own, so that ``torch.compile`` keeps it whole; gradients go to the features and the embeddings,
which is where they are not recomputed but read again: forward keeps nothing but its inputs.
"""

import torch
from torch import Tensor

from egovm.solver_kernels import add_embedding_gradient, add_feature_gradient, dot_patches

_CHUNK = 64
"""Points whose patches torch gathers at once: 30 MB at 256 channels."""
_STRIP = 16
"""Rows of a strip of the map."""
_WIDEST = 1 << 20
"""More than any map has columns."""


def patch_dots(
    features: Tensor, embeddings: Tensor, corners: Tensor, valid: Tensor, size: int, groups: int = 1
) -> Tensor:
    """Dots (B, N, G, S, S) of each group of channels over the patch of S x S cells at each point's corner.

    features: (B, H, W, C), best contiguous so; embeddings: (B, N, C) float32 or float64; corners: (B, N, 2) int64, such
    that the patch lies on the map; valid: (B, N) bool, points for which there is nothing to do have zeros.
    """
    if exporting():
        return gathered_dots(features, embeddings, corners, valid, size, groups)
    found: Tensor = _patch_dots(features, embeddings, corners, valid, size, groups)
    return found


def gathered_dots(
    features: Tensor, embeddings: Tensor, corners: Tensor, valid: Tensor, size: int, groups: int
) -> Tensor:
    """The same in plain torch, on any device."""
    parts = [
        _dots_of(_gathered(features, corners[:, s], size, embeddings.dtype), embeddings[:, s], groups)
        for s in chunks(corners.shape[1])
    ]
    dots = torch.unflatten(torch.cat(parts, 1), -1, (size, size))
    return torch.where(valid[:, :, None, None, None], dots, torch.zeros((), dtype=dots.dtype, device=dots.device))


@torch.library.custom_op("egovm::patch_dots", mutates_args=())
def _patch_dots(features: Tensor, embeddings: Tensor, corners: Tensor, valid: Tensor, size: int, groups: int) -> Tensor:
    if not (_by_kernel(features, embeddings) or _short(features, embeddings)):
        return gathered_dots(features, embeddings, corners, valid, size, groups)
    samples, points = valid.shape
    dots = embeddings.new_zeros((samples, points, groups, size, size))
    dot_patches(*_arrays(_split(features, groups), _split(embeddings, groups), corners, valid, _order(corners), dots))
    return dots


@_patch_dots.register_fake
def _(features: Tensor, embeddings: Tensor, corners: Tensor, valid: Tensor, size: int, groups: int) -> Tensor:
    return embeddings.new_empty((*valid.shape, groups, size, size))


@torch.library.custom_op("egovm::patch_dots_backward", mutates_args=())
def _patch_dots_backward(
    features: Tensor, embeddings: Tensor, corners: Tensor, valid: Tensor, gradient: Tensor
) -> tuple[Tensor, Tensor]:
    of_features = torch.zeros(features.shape, dtype=embeddings.dtype, device=features.device)
    of_embeddings = torch.zeros_like(embeddings, memory_format=torch.contiguous_format)
    if _by_kernel(features, embeddings):
        groups = gradient.shape[2]
        add_feature_gradient(
            *_arrays(_split(embeddings, groups), corners, valid, gradient, _split(of_features, groups))
        )
        add_embedding_gradient(
            *_arrays(_split(features, groups), corners, valid, gradient, _split(of_embeddings, groups))
        )
    else:
        _add_gathered(
            features,
            embeddings,
            corners,
            torch.where(valid[:, :, None, None, None], gradient, 0.0),
            of_features,
            of_embeddings,
        )
    return of_features.to(features.dtype), of_embeddings


@_patch_dots_backward.register_fake
def _(features: Tensor, embeddings: Tensor, corners: Tensor, valid: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    return features.new_empty(features.shape), embeddings.new_empty(embeddings.shape)


def _keep(ctx: torch.autograd.function.FunctionCtx, inputs: tuple[Tensor, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])


def _backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor | None, ...]:
    of_features, of_embeddings = _patch_dots_backward(*ctx.saved_tensors, gradient)  # type: ignore[attr-defined]
    return of_features, of_embeddings, None, None, None, None


_patch_dots.register_autograd(_backward, setup_context=_keep)


def _by_kernel(features: Tensor, embeddings: Tensor) -> bool:
    return features.device.type == "cpu" and features.dtype == embeddings.dtype in (torch.float32, torch.float64)


def _short(features: Tensor, embeddings: Tensor) -> bool:
    """Features that the forward kernel reads in half as many bytes."""
    return features.device.type == "cpu" and (features.dtype, embeddings.dtype) == (torch.bfloat16, torch.float32)


def _arrays(*tensors: Tensor) -> list[object]:
    """Contiguous numpy views, bfloat16 as its bits: other strides would each be compiled anew."""
    laid = [each.detach().contiguous() for each in tensors]
    return [(each.view(torch.uint16) if each.dtype == torch.bfloat16 else each).numpy() for each in laid]


def _order(corners: Tensor) -> Tensor:
    """(B, N) of points (B, N, 2) by strips of the map, along each by column; equal ones stay in their order."""
    return (corners[..., 0] // _STRIP * _WIDEST + corners[..., 1]).argsort(dim=1, stable=True)


def _split(channels: Tensor, groups: int) -> Tensor:
    """(..., G, C / G) of (..., C)."""
    return torch.unflatten(channels, -1, (groups, channels.shape[-1] // groups))


def exporting() -> bool:
    """Whether a graph is being made for elsewhere."""
    return torch.compiler.is_exporting() or torch.onnx.is_in_onnx_export()


def chunks(points: int) -> list[slice]:
    """Parts of so many points or elements that go through memory at once; in exports all, for their number is open."""
    if exporting():
        return [slice(None)]
    return [slice(s, min(s + _CHUNK, points)) for s in range(0, max(points, 1), _CHUNK)]


def _cells(corners: Tensor, size: int, height: int, width: int) -> Tensor:
    """(B N S S) int64 cells of the patches in maps laid one after the other, row by row."""
    steps = torch.arange(size, device=corners.device)
    sample = torch.arange(len(corners), device=corners.device)[:, None, None] * height
    rows, columns = sample + corners[..., 0, None] + steps, corners[..., 1, None] + steps
    return (rows[..., :, None] * width + columns[..., None, :]).flatten()


def _gathered(features: Tensor, corners: Tensor, size: int, dtype: torch.dtype) -> Tensor:
    """(B, N, S S, C) features of the patches."""
    samples, height, width, channels = features.shape
    picked = features.flatten(0, 2).index_select(0, _cells(corners, size, height, width))
    return picked.to(dtype).view(samples, corners.shape[1], size * size, channels)


def _dots_of(patches: Tensor, embeddings: Tensor, groups: int) -> Tensor:
    """(B, N, G, S S)."""
    return torch.einsum("bnsgc,bngc->bngs", _split(patches, groups), _split(embeddings, groups))


def _add_gathered(
    features: Tensor, embeddings: Tensor, corners: Tensor, gradient: Tensor, of_features: Tensor, of_embeddings: Tensor
) -> None:
    """Add the gradients, some points at a time."""
    size, groups = gradient.shape[-1], gradient.shape[2]
    channels = features.shape[3]
    for s in chunks(corners.shape[1]):
        given = gradient[:, s].flatten(3)
        patches = _split(_gathered(features, corners[:, s], size, embeddings.dtype), groups)
        of_embeddings[:, s] = torch.einsum("bngs,bnsgc->bngc", given, patches).flatten(2)
        spread = torch.einsum("bngs,bngc->bnsgc", given, _split(embeddings[:, s], groups))
        cells = _cells(corners[:, s], size, *features.shape[1:3])
        of_features.flatten(0, 2).index_add_(0, cells, spread.reshape(-1, channels))
