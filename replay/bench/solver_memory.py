"""Memory that the forward solve takes beyond its inputs, in a fresh process: peak resident size against that before.

The kernels are compiled and torch is warm before, by a solve of the same maps with one element.
"""

import subprocess
import sys

import torch

from egovm.pose_solver import PoseSolver
from replay.bench.memory import peak_mb, resident_mb
from replay.bench.solver_scene import SIZES, Scene, scene


def peak_growth_mb(size: str, elements: int, last: bool) -> float:
    """MB; NaN where the system does not tell it."""
    command = [sys.executable, "-m", __name__, size, str(elements), str(int(last))]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _grown_mb(size: str, elements: int, last: bool) -> float:
    torch.set_num_threads(1)
    given, solver = scene(SIZES[size], elements, last=last), PoseSolver()
    with torch.no_grad():
        tiny = scene(SIZES[size], 1)
        _solve(solver, tiny)
        del tiny
        before = resident_mb()
        _forget_peak()
        _solve(solver, given)
    return peak_mb() - before


def _solve(solver: PoseSolver, given: Scene) -> None:
    solver(given.features, given.embeddings, given.places, given.valid)


def _forget_peak() -> None:
    """Let the kernel begin anew with the largest resident size; without Linux the peak before it stays."""
    try:
        with open("/proc/self/clear_refs", "w") as refs:
            refs.write("5")
    except OSError:
        pass


if __name__ == "__main__":
    print(_grown_mb(sys.argv[1], int(sys.argv[2]), sys.argv[3] == "1"))
