"""What one frame forward and backward through the BEV side of a preset costs a fresh process: seconds, and MB."""

import subprocess
import sys
import time

import torch

from egovm.bev_network import BevNetwork
from egovm.config import PRESETS
from replay.bench.memory import peak_mb
from replay.bench.network_scene import scene


def training_step(preset: str) -> tuple[float, float]:
    """Seconds forward and backward, and MB of the process at its largest, imports and weights with it."""
    done = subprocess.run([sys.executable, "-m", __name__, preset], check=True, capture_output=True, text=True)
    seconds, peak = map(float, done.stdout.split()[-2:])
    return seconds, peak


def _step(preset: str) -> float:
    """Seconds of one step with all sensors."""
    config = PRESETS[preset]
    torch.manual_seed(0)
    network = BevNetwork(config).train()
    network.drops = (0.0, 0.0)
    points, images = scene(config)
    start = time.perf_counter()
    torch.stack([found.square().mean() for found in network(points, images)]).sum().backward()  # type: ignore[no-untyped-call]
    if not all(p.grad.isfinite().all() for p in network.parameters() if p.grad is not None):
        raise FloatingPointError(f"{preset}: a gradient is not finite")
    return time.perf_counter() - start


if __name__ == "__main__":
    print(_step(sys.argv[1]), peak_mb())
