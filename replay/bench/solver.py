"""`egoloc bench solver`: the pose solver beside sampling features at every candidate, at the networks' sizes.

Both solve the same random scene on one thread, by turns, so that a noisy hour is the same for both; backward is that
of the composed offset and the covariances to features and embeddings. In float64 both must say the same.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from egovm.lattice import PAPER
from egovm.pose_solver import PoseEstimate, PoseSolver
from egovm.solver_window import window_cells
from replay.bench import solver_sampling
from replay.bench.measure import conditions, row
from replay.bench.solver_memory import peak_growth_mb
from replay.bench.solver_scene import CELLS, SIZES, Scene, scene

ELEMENTS = 500
SCALING = (125, 250, 500, 1000)
PEER = "sampling"


def run(
    repeats: int = 3,
    elements: int = ELEMENTS,
    scaling: tuple[int, ...] = SCALING,
    sizes: tuple[str, ...] = tuple(SIZES),
) -> dict[str, Any]:
    """Times over so many repeats, of so many elements; scaling: numbers of elements over which the growth is taken.

    sizes: names of SIZES; growth and memory are those of the first, the agreement that of the last.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        rows: list[dict[str, Any]] = []
        ratios: dict[str, float] = {}
        for size in sizes:
            found, ratio = _beside(size, elements, repeats)
            rows += found
            ratios |= ratio
        rows += _growth(sizes[0], scaling, repeats)
        rows += [*_memory(sizes[0], elements), *_work(sizes, elements), *_agreement(sizes[-1], elements)]
    finally:
        torch.set_num_threads(threads)
    facts = {
        "elements": elements,
        "cells": CELLS,
        "channels": {size: SIZES[size] for size in sizes},
        "candidates": f"{PAPER.steps}^3 at {PAPER.levels} levels",
        "threads": 1,
        "repeats": repeats,
    }
    return {"bench": "solver", "rows": rows, "ratios": ratios, "conditions": conditions(["torch", "numba"], **facts)}


def solve(solver: PoseSolver, given: Scene) -> PoseEstimate:
    """The estimate of a scene."""
    found: PoseEstimate = solver(given.features, given.embeddings, given.places, given.valid)
    return found


def _beside(size: str, elements: int, repeats: int) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Milliseconds of both, forward and with gradients, and how many times a peer takes ours."""
    given, solver = scene(SIZES[size], elements), PoseSolver()
    for leaf in given.leaves():
        leaf.requires_grad_()
    first = scene(SIZES[size], elements, last=False)
    ours: dict[str, Callable[[], object]] = {
        f"egoloc, {size}": lambda: solve(solver, given),
        f"egoloc, {size}, channels first": lambda: solve(solver, first),
        f"{PEER}, {size}": lambda: solver_sampling.sampled_estimate(given),
    }
    with torch.no_grad():
        forward = _by_turns(ours, repeats)
    both = _by_turns(
        {
            f"egoloc, {size}": lambda: _backward(given, *_ours(solver, given)),
            f"{PEER}, {size}": lambda: _backward(given, *_theirs(given)),
        },
        repeats,
    )
    rows = [row(name, "forward_ms", taken) for name, taken in forward.items()]
    rows += [row(name, "forward_backward_ms", taken) for name, taken in both.items()]
    ratios = {
        f"{PEER} / egoloc, {size}, {what}": _median(times, f"{PEER}, {size}") / _median(times, f"egoloc, {size}")
        for what, times in (("forward", forward), ("forward and backward", both))
    }
    return rows, ratios


def _ours(solver: PoseSolver, given: Scene) -> tuple[torch.Tensor, list[torch.Tensor]]:
    found = solve(solver, given)
    return found.offset, [each.cov for each in found.levels]


def _theirs(given: Scene) -> tuple[torch.Tensor, list[torch.Tensor]]:
    offset, _, covs = solver_sampling.sampled_estimate(given)
    return offset, covs


def _backward(given: Scene, offset: torch.Tensor, covs: list[torch.Tensor]) -> None:
    torch.autograd.grad(offset.sum() + torch.stack(covs).sum(), given.leaves())


def _by_turns(works: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each, one after the other in every repeat, after a turn that warms up."""
    taken: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(repeats + 1):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            if turn:
                taken[name].append(1e3 * (time.perf_counter() - start))
    return taken


def _growth(size: str, scaling: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Forward time over the number of elements: its exponent (1 is linear, less has a fixed part) and its line.

    The line's fixed part and slope, and the largest departure from it as a share of the time.
    """
    solver = PoseSolver()
    largest = scene(SIZES[size], max(scaling))
    scenes = {k: largest.first(k) for k in scaling}
    works: dict[str, Callable[[], object]] = {
        f"egoloc, {size}, {k} elements": lambda given=given: solve(solver, given)  # type: ignore[misc]
        for k, given in scenes.items()
    }
    with torch.no_grad():
        taken = _by_turns(works, repeats)
    least = [min(each) for each in taken.values()]
    exponent = float(np.polyfit(np.log(scaling), np.log(least), 1)[0])
    slope, fixed = np.polyfit(scaling, least, 1)
    departure = float(np.abs(fixed + slope * np.array(scaling) - least).max() / max(least))
    return [
        *(row(name, "forward_ms", each) for name, each in taken.items()),
        row(f"egoloc, {size}", "growth_exponent", [exponent]),
        row(f"egoloc, {size}", "fixed_ms", [float(fixed)]),
        row(f"egoloc, {size}", "us_per_element", [1e3 * float(slope)]),
        row(f"egoloc, {size}", "departure_from_line", [departure]),
    ]


def _memory(size: str, elements: int) -> list[dict[str, Any]]:
    return [
        row(f"egoloc, {size}", "peak_mb_beyond_inputs", [peak_growth_mb(size, elements, True)]),
        row(f"egoloc, {size}, channels first", "peak_mb_beyond_inputs", [peak_growth_mb(size, elements, False)]),
    ]


def _work(sizes: tuple[str, ...], elements: int) -> list[dict[str, Any]]:
    """Millions of multiply-adds of features: dots of patches against samples and dots at every candidate."""
    rows = []
    for size in sizes:
        channels = SIZES[size]
        patches = sum(
            window_cells(PAPER, level, n, n) ** 2 * c * elements
            for level, (n, c) in enumerate(zip(CELLS, channels, strict=True))
        )
        sampled = sum(solver_sampling.multiply_adds(elements, c) for c in channels)
        rows += [
            row(f"egoloc, {size}", "million_multiply_adds", [patches / 1e6]),
            row(f"{PEER}, {size}", "million_multiply_adds", [sampled / 1e6]),
        ]
    return rows


def _agreement(size: str, elements: int) -> list[dict[str, Any]]:
    """Largest differences from the peer over all levels, in float64: m and rad, and their products."""
    given = scene(SIZES[size], elements, torch.float64)
    with torch.no_grad():
        ours = solve(PoseSolver(), given)
        offset, means, covs = solver_sampling.sampled_estimate(given)
    mean = max(float((a.mean[0] - b).abs().max()) for a, b in zip(ours.levels, means, strict=True))
    cov = max(float((a.cov[0] - b).abs().max()) for a, b in zip(ours.levels, covs, strict=True))
    return [
        row("egoloc against sampling, float64", "mean_difference", [mean]),
        row("egoloc against sampling, float64", "covariance_difference", [cov]),
        row("egoloc against sampling, float64", "offset_difference", [float((ours.offset[0] - offset).abs().max())]),
    ]


def _median(taken: dict[str, list[float]], name: str) -> float:
    return float(np.median(taken[name]))
