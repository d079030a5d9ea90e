"""`egoloc bench network`: the networks' BEV side by part: time of a frame, parameters, multiply-adds, training memory.

Times are of one frame, batch norms folded, on as many threads as there are cores and on one; milliseconds of the clock
and of the processor. On a machine with other work, threads that wait for each other spoil the former: the processor's
time on one thread is what then can be compared. A part's are taken within the whole's.
Multiply-adds are those of convolutions and matrix products, counted by PyTorch; what is read bilinearly is not in them.
"""

import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from egovm.batch import Images, Points
from egovm.bev_fusion import ImageAttention
from egovm.bev_network import BevNetwork
from egovm.config import PAPER, SMALL, NetworkConfig
from egovm.convolutions import deployed
from replay.bench.measure import conditions, row
from replay.bench.network_scene import CAMERAS, POINTS, scene
from replay.bench.network_training import training_step

PARTS = ("camera", "lidar", "fusion", "pyramid", "queries")
Rows = list[dict[str, Any]]
Scene = tuple[Points | None, Images | None]


def run(repeats: int = 5, paper: bool = True) -> dict[str, Any]:
    """Times of ``small``, sizes of both presets; paper: also a training step of ``paper``, a minute or more."""
    threads = torch.get_num_threads()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        rows = [each for count in dict.fromkeys((cores, 1)) for each in _times(SMALL, repeats, count)]
    finally:
        torch.set_num_threads(threads)
    for config in (SMALL, PAPER):
        rows += _sizes(config)
    for preset in ("small", "paper") if paper else ("small",):
        seconds, peak = training_step(preset)
        rows += [row(f"{preset}, training step", "s", [seconds]), row(f"{preset}, training step", "peak_mb", [peak])]
    median = {(each["name"], each["metric"]): each["median"] for each in rows}
    seen, every = (median[f"small, {mode}, threads 1: fusion", "cpu_ms"] for mode in ("full", "full all pairs"))
    facts = {"cameras": CAMERAS, "points": POINTS, "threads": cores, "repeats": repeats}
    return {
        "bench": "network",
        "rows": rows,
        "ratios": {"fusion, all pairs / seen pairs": every / seen},
        "conditions": conditions(["torch", "timm"], **facts),
    }


def _times(config: NetworkConfig, repeats: int, threads: int) -> Rows:
    """Of the modes, and of full mode with each query computed for each camera."""
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    network = deployed(BevNetwork(config))
    points, images = scene(config)
    modes: dict[str, Scene] = {"full": (points, images), "visual": (None, images), "lidar": (points, None)}
    rows: Rows = []
    for mode, given in modes.items():
        rows += _rows(f"{config.name}, {mode}, threads {threads}", _timed(network, given, repeats))
    for module in network.modules():
        if isinstance(module, ImageAttention):
            module.dense = True
    return rows + _rows(f"{config.name}, full all pairs, threads {threads}", _timed(network, modes["full"], repeats))


def _rows(name: str, spent: dict[str, list[tuple[float, float]]]) -> Rows:
    """The whole under its name, parts after a colon."""
    return [
        row(name + (f": {part}" if part else ""), metric, [1e3 * pair[which] for pair in pairs])
        for part, pairs in spent.items()
        for which, metric in enumerate(("ms", "cpu_ms"))
    ]


def _timed(network: nn.Module, given: Scene, repeats: int) -> dict[str, list[tuple[float, float]]]:
    """Seconds of the clock and of the processor by part, the whole under no name; after two calls that warm up."""
    spent: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with torch.inference_mode(), _watched(network, spent):
        for _ in range(repeats + 2):
            network(*given)
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

    watched = {"": network, **{name: part for name, part in network.named_children() if name in PARTS}}
    hooks = []
    for name, part in watched.items():
        hooks.append(part.register_forward_pre_hook(lambda *_, name=name: begin(name)))
        hooks.append(part.register_forward_hook(lambda *_, name=name: end(name)))
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _sizes(config: NetworkConfig) -> Rows:
    """Parameters and multiply-adds of a frame in full mode, of the whole and by part."""
    torch.manual_seed(0)
    network = BevNetwork(config).eval()
    counter = FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        network(*scene(config))
    counted = counter.get_flop_counts()
    rows: Rows = []
    for part, module in {"": network, **dict(network.named_children())}.items():
        name = config.name + (f": {part}" if part else "")
        flops = sum(counted.get("BevNetwork" + (f".{part}" if part else ""), {}).values())
        rows.append(row(name, "parameters", [sum(p.numel() for p in module.parameters())]))
        rows.append(row(name, "multiply_adds", [flops / 2]))
    return rows
