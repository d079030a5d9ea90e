"""A trained network as ONNX, for runtimes other than PyTorch: the graph of one mode, and what its users must know.

Needs the extra ``export`` (onnx, onnxscript, onnxruntime).
"""

import io
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import nn

from egovm.config import NetworkConfig
from egovm.config_file import config_toml
from egovm.export_graph import OUTPUTS, FrameGraph, Inputs, Mode, kind_of, names_of, open_dimension
from egovm.timm_models import normalization
from sensors.errors import EgolocError

OPSET = 18
NEEDED = ("onnx", "onnxscript", "onnxruntime")
AXES = (
    "body at the initial pose, x ahead, y left, z up, lifted so that the ground is at z = bev.ground_m of the config;"
    " offset = T_init^-1 T_est; log_p by yaw, x, y, all rising, translations turned by the yaw"
)
UNITS = "m, rad; offset and modes (m, m, rad); cov (m, m, rad)^2; points_intensity 0 to 1; images_K pixels"


def check_installed() -> None:
    """Raise EgolocError where something of the extra is missing."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise EgolocError(f"export: expected {', '.join(missing)}, not installed: pip install egoloc[export]")


def write_onnx(
    network: nn.Module,
    config: NetworkConfig,
    mode: Mode,
    sample: Inputs,
    path: Path,
    notes: Mapping[str, str] | None = None,
) -> None:
    """Write the graph of a mode.

    network: an EgoVM in evaluation, best ``deployed``; sample: inputs of that mode, two or more of all that stays open:
    what is written does not depend on their values or numbers; notes: what else the file tells, beside ``metadata``.
    """
    import onnx

    model = _converted(FrameGraph(network).eval(), sample, mode)
    _anonymous(model.graph)
    _open_named(model.graph)
    for key, value in (metadata(config, mode) | dict(notes or {})).items():
        entry = model.metadata_props.add()
        entry.key, entry.value = f"egoloc.{key}", value
    model.producer_name, model.producer_version = "egoloc", version("egoloc")
    onnx.checker.check_model(model)
    onnx.save(model, path)


def metadata(config: NetworkConfig, mode: Mode) -> dict[str, str]:
    """What is written beside the graph, as text."""
    told = {"version": version("egoloc"), "mode": mode, "config": config_toml(config), "axes": AXES, "units": UNITS}
    if mode != "lidar" and config.camera is not None:
        mean, deviation = normalization(config.camera.backbone)
        told |= {"rgb_mean": _numbers(mean), "rgb_deviation": _numbers(deviation)}
    return told


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def _converted(graph: nn.Module, sample: Inputs, mode: Mode) -> Any:
    """An onnx.ModelProto."""
    with torch.no_grad(), _quiet():
        program = torch.export.export(graph, (sample,), dynamic_shapes=(_open(sample),), strict=False)
        converted = torch.onnx.export(
            program,
            input_names=names_of(mode),
            output_names=OUTPUTS,
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert converted is not None
    return converted.model_proto


def _open(sample: Inputs) -> dict[str, dict[int, Any]]:
    """Which dimensions of each input are open; torch would have taken a 1 for closed."""
    dimensions = {kind: torch.export.Dim(kind, min=2, max=2**22) for kind in {kind_of(name) for name in sample}}
    for name, value in sample.items():
        if value.shape[open_dimension(name)] < 2:
            raise ValueError(f"write_onnx: {name}: expected a sample of two or more, got {tuple(value.shape)}")
    return {name: {open_dimension(name): dimensions[kind_of(name)]} for name in sample}


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter tells of its own working in warnings, logs and on standard output."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


def _anonymous(graph: Any) -> None:
    """Without what the exporter notes of the Python code: files and lines of this machine, half of the file."""
    for each in (graph, *graph.node, *graph.input, *graph.output, *graph.initializer):
        del each.metadata_props[:]
        each.doc_string = ""
    del graph.value_info[:]


def _open_named(graph: Any) -> None:
    """Names instead of numbers for what stays open."""
    names = {
        given.type.tensor_type.shape.dim[open_dimension(given.name)].dim_param: kind_of(given.name)
        for given in graph.input
    }
    for each in (*graph.input, *graph.output):
        for dimension in each.type.tensor_type.shape.dim:
            if dimension.dim_param:
                dimension.dim_param = names[dimension.dim_param]
