"""`egoloc bench network`: a frame through the networks by part: time, parameters, multiply-adds, training memory.

Times are of one frame, from tensors of points, images and map elements to a pose, through the network as it is
deployed, on as many threads as there are cores and on one; milliseconds of the clock and of the processor. On a machine
with other work, threads that wait for each other spoil the former: the processor's time on one thread is what then can
be compared. A part's are taken within the whole's.
Multiply-adds are those of convolutions, matrix products, and the solver's dots and their sums; what is read bilinearly
elsewhere is not in them.
"""

import math
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from egovm.batch import Batch
from egovm.bev_fusion import ImageAttention
from egovm.config import PAPER, SMALL, SMALL_LIDAR, NetworkConfig
from egovm.convolutions import deployed, native_precision
from egovm.network import EgoVM
from replay.bench.measure import conditions, row
from replay.bench.network_scene import CAMERAS, POINTS, scene
from replay.bench.network_training import training_step

TIMED = ("bev.lidar", "bev.camera", "bev.fusion", "bev.pyramid", "matching", "solver")
PARTS = (*TIMED, "bev.queries", "semantics")
Rows = list[dict[str, Any]]


def run(repeats: int = 5, paper: bool = True) -> dict[str, Any]:
    """Times of ``small`` and ``small-lidar``, sizes of all; paper: also a training step of ``paper``, minutes."""
    threads = torch.get_num_threads()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        rows = [each for count in dict.fromkeys((cores, 1)) for each in _times(repeats, count)]
    finally:
        torch.set_num_threads(threads)
    for config in (SMALL_LIDAR, SMALL, PAPER):
        rows += _sizes(config)
    for preset in ("small", "paper") if paper else ("small",):
        seconds, peak = training_step(preset)
        rows += [row(f"{preset}, training step", "s", [seconds]), row(f"{preset}, training step", "peak_mb", [peak])]
    facts = {"cameras": CAMERAS, "points": POINTS, "elements": SMALL.matching.most_elements, "threads": cores}
    return {
        "bench": "network",
        "rows": rows,
        "ratios": _ratios({(each["name"], each["metric"]): each["median"] for each in rows}),
        "conditions": conditions(["torch", "timm"], precision=str(native_precision()), repeats=repeats, **facts),
    }


def _ratios(median: dict[tuple[str, str], float]) -> dict[str, float]:
    seen, every = (median[f"small, {kind}, threads 1: bev.fusion", "cpu_ms"] for kind in ("full", "full all pairs"))
    quick, exact = (median[f"small, {kind}, threads 1", "cpu_ms"] for kind in ("full", "full float32"))
    return {"fusion, all pairs / seen pairs": every / seen, "full, float32 / deployed": exact / quick}


def _times(repeats: int, threads: int) -> Rows:
    """Of the modes; of full mode in float32, and with each query computed for each camera."""
    torch.set_num_threads(threads)
    batch, network = scene(SMALL), _network(SMALL, native_precision())
    lidar, visual = Batch(batch.points, None, batch.elements), Batch(None, batch.images, batch.elements)
    turns = {
        "small, full": (network, batch),
        "small, visual": (network, visual),
        "small, lidar": (network, lidar),
        "small-lidar": (_network(SMALL_LIDAR, native_precision()), lidar),
        "small, full float32": (_network(SMALL, None), batch),
        "small, full all pairs": (_dense(_network(SMALL, native_precision())), batch),
    }
    rows: Rows = []
    for name, (each, given) in turns.items():
        rows += _rows(f"{name}, threads {threads}", _timed(each, given, repeats))
    return rows


def _network(config: NetworkConfig, precision: torch.dtype | None) -> nn.Module:
    torch.manual_seed(0)
    return deployed(EgoVM(config), precision)


def _dense(network: nn.Module) -> nn.Module:
    for module in network.modules():
        if isinstance(module, ImageAttention):
            module.dense = True
    return network


def _rows(name: str, spent: dict[str, list[tuple[float, float]]]) -> Rows:
    """The whole under its name, parts after a colon."""
    return [
        row(name + (f": {part}" if part else ""), metric, [1e3 * pair[which] for pair in pairs])
        for part, pairs in spent.items()
        for which, metric in enumerate(("ms", "cpu_ms"))
    ]


def _timed(network: nn.Module, given: Batch, repeats: int) -> dict[str, list[tuple[float, float]]]:
    """Seconds of the clock and of the processor by part, the whole under no name; after two calls that warm up."""
    spent: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with torch.inference_mode(), _watched(network, spent):
        for _ in range(repeats + 2):
            network(given)
    return {part: pairs[2:] for part, pairs in spent.items()}


@contextmanager
def _watched(network: nn.Module, spent: dict[str, list[tuple[float, float]]]) -> Iterator[None]:
    """Add what each call of the network and of its parts takes."""
    begun: dict[str, tuple[float, float]] = {}

    def begin(name: str) -> None:
        begun[name] = time.perf_counter(), time.process_time()

    def end(name: str) -> None:
        clock, processor = begun[name]
        spent[name].append((time.perf_counter() - clock, time.process_time() - processor))

    modules = dict(network.named_modules())
    hooks = []
    for name in ("", *(part for part in TIMED if part in modules)):
        hooks.append(modules[name].register_forward_pre_hook(lambda *_, name=name: begin(name)))
        hooks.append(modules[name].register_forward_hook(lambda *_, name=name: end(name)))
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _sizes(config: NetworkConfig) -> Rows:
    """Parameters and multiply-adds of a frame in full mode with semantics, of the whole and by part."""
    torch.manual_seed(0)
    network = EgoVM(config).eval().requires_grad_(False)
    ours: dict[Any, Any] = {torch.ops.egovm.patch_dots: _dots, torch.ops.egovm.lattice_sums: _sums}
    counter = FlopCounterMode(display=False, custom_mapping=ours)
    with torch.inference_mode(), counter:
        network(scene(config), semantics=True)
    counted, modules = counter.get_flop_counts(), dict(network.named_modules())
    rows: Rows = []
    for part in ("", *(part for part in PARTS if part in modules)):
        name = config.name + (f": {part}" if part else "")
        flops = sum(counted.get("EgoVM" + (f".{part}" if part else ""), {}).values())
        rows.append(row(name, "parameters", [sum(p.numel() for p in modules[part].parameters())]))
        rows.append(row(name, "multiply_adds", [flops / 2]))
    return rows


def _dots(features: torch.Size, *_: object, out_shape: torch.Size, **__: object) -> int:
    """Flops of the solver's dots (B, N, G, S, S) of features (B, H, W, C)."""
    return 2 * features[-1] * math.prod(out_shape) // out_shape[2]


def _sums(dots: torch.Size, *_: object, out_shape: torch.Size, **__: object) -> int:
    """Flops of the sums (B, yaw, n, n) of dots (B, N, G, S, S), four to a candidate."""
    return 2 * 4 * math.prod(out_shape) * dots[1] * dots[2]
