"""Image backbones from timm, which brings no weights: none are downloaded, a file of them may be given.

timm imports torchvision, though no backbone needs its compiled operators. A torchvision that was built for another
torch (its CUDA wheel beside torch for the CPU, as plain ``pip install`` puts them) fails at its import for want of two
of them; naming them is enough.
"""

from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import nn

from sensors.errors import EgolocError

_MISSING = ("nms", "qnms")
_SCHEMA = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


def backbone(name: str, weights: Path | None = None) -> nn.Module:
    """A backbone that gives features at stride 16 and 32. weights: timm's own file of them, safetensors or PyTorch.

    Raises EgolocError for a name that timm does not know, strides that it does not give, and a file that does not fit.
    """
    timm = _timm()
    if not timm.is_model(name):
        raise EgolocError(f"camera: backbone: expected a model of timm {timm.__version__}, got {name!r}")
    given: dict[str, Any] = {} if weights is None else _from_file(timm, name, weights)
    try:
        found: nn.Module = timm.create_model(name, features_only=True, out_indices=(-2, -1), **given)
    except (RuntimeError, KeyError, AssertionError) as error:
        told = str(error).splitlines()[0]
        raise EgolocError(f"{weights or 'camera: backbone'}: expected one of {name}: {told}") from None
    strides = found.feature_info.reduction()  # type: ignore[operator, union-attr]
    if strides != [16, 32]:
        raise EgolocError(f"camera: backbone: expected one with features at stride 16 and 32, {name!r} has {strides}")
    return found


def normalization(name: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and standard deviation of red, green and blue (0..1) that a backbone's images are brought from.

    Raises EgolocError for a name that timm does not know.
    """
    timm = _timm()
    if not timm.is_model(name):
        raise EgolocError(f"camera: backbone: expected a model of timm {timm.__version__}, got {name!r}")
    # a model without pretrained weights has no entry
    known = timm.get_pretrained_cfg(name) or timm.models.PretrainedCfg()
    return tuple(known.mean), tuple(known.std)


def _from_file(timm: ModuleType, name: str, weights: Path) -> dict[str, Any]:
    """What makes timm read the file. timm takes any: one in which something of the backbone is missing raises."""
    if not weights.is_file():
        raise EgolocError(f"{weights}: expected a file with weights of {name}, found none")
    try:
        given = timm.models.load_state_dict(str(weights), use_ema=False, weights_only=True)
    except Exception as error:  # safetensors, zip and pickle errors have no common kind
        raise EgolocError(f"{weights}: expected a file with weights of {name}: {str(error).splitlines()[0]}") from None
    bare = timm.create_model(name, features_only=True, out_indices=(-2, -1))
    names = {_flat(key) for key in given}
    for key in bare.state_dict():
        if _flat(key) not in names and not key.endswith("num_batches_tracked"):
            raise EgolocError(f"{weights}: expected weights of {name}, {key} is missing")
    return {"pretrained": True, "pretrained_cfg_overlay": {"file": str(weights)}}


def _flat(key: str) -> str:
    """A name of a weight without what timm changes when it cuts a backbone out of a classifier: stages.0, stages_0."""
    return key.replace("_", ".")


def _timm() -> ModuleType:
    """timm; where torchvision's operators are missing, they are named first."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        for name in _MISSING:
            torch.library.define(f"torchvision::{name}", _SCHEMA)
    import timm

    return timm
