"""Memory of a replay, measured in fresh processes: it does not follow the length of the drive."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys
from pathlib import Path
import msgspec
from replay.bench.memory import peak_mb
from replay.config import HideGnss, RunConfig
from replay.harness import replay_source
from replay.sources import ScenarioSource
from sensors.simulate.scenarios import load

hours, out, hide = float(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "True"
scenario = load("demo")
rates = {"imu": 20.0, "gnss": 2.0, "pose_fix": 2.0, "wheel": 2.0, "reference": 2.0}
slow = {name: msgspec.structs.replace(getattr(scenario, name), rate_hz=hz) for name, hz in rates.items()}
scenario = msgspec.structs.replace(scenario, duration_s=3600.0 * hours, length_km=None, **slow)
config = RunConfig(hide_gnss=HideGnss(60.0, 15.0) if hide else None)
metrics = replay_source(ScenarioSource(scenario), out, config)
assert metrics["span_s"] > 3500.0 * hours
print(peak_mb())
"""


def peak_mb(hours: float, out: object, *, hide: bool) -> float:
    arguments = [sys.executable, "-c", PROGRAM, str(hours), str(out), str(hide)]
    return float(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)


@pytest.mark.slow
@pytest.mark.parametrize("hide", [False, True])
def test_eight_hours_take_no_more_than_one(hide: bool, tmp_path: object) -> None:
    one, eight = (peak_mb(hours, f"{tmp_path}/{hours:g}h", hide=hide) for hours in (1.0, 8.0))
    assert one < 500
    assert eight < one + 80
