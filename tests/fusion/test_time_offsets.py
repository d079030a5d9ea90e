"""The delay of GNSS on recorded drives: as a state, beside the fixed delay under which innovations are most likely."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fusion.config import Estimate, FusionConfig, Gates
from fusion.innovations import joint
from fusion.result import Estimated, Sensor
from fusion.run import run
from sensors.clock import NS_PER_S
from sensors.datasets import load
from sensors.records import Log

pytestmark = pytest.mark.slow

CLOSE_S = 0.02
DRIVES = (
    ("rtklib", "rtk_drive"),
    ("imu-gnss-drive", "imu_gnss_drives/mixed-road-long-drive-nominal-001"),
    ("imu-gnss-drive", "imu_gnss_drives/parking-lot-figure8-nominal-001"),
    ("imu-gnss-drive", "imu_gnss_drives/urban-long-turn-loop-nominal-001"),
    ("imu-gnss-drive", "imu_gnss_drives/urban-medium-turn-loop-nominal-001"),
)
"""Not parkinglot-maneuvers, whose likelihood leaps between -0.06 and -0.08 s (docs/datasets.md)."""
OPEN = FusionConfig(gates=Gates(use=False))
"""Which innovations count must not depend on the delay."""


def shifted(log: Log, by_s: float) -> Log:
    """The log with both delays of its vehicle changed."""
    vehicle = log.vehicle
    vehicle = msgspec.structs.replace(
        vehicle,
        gnss_delay_s=vehicle.gnss_delay_s + by_s,
        gnss_velocity_delay_s=vehicle.gnss_velocity_delay_s + by_s,
    )
    return replace(log, vehicle=vehicle)


def misfit(log: Log, by_s: float) -> float:
    """Minus twice the logarithm of the likelihood of GNSS, but for a constant: NIS and the size of the ellipsoids.

    The first minute, in which yaw and biases settle, does not count.
    """
    assert log.imu is not None
    result = run(shifted(log, by_s), OPEN)
    assert result.aligned_ns is not None
    sensors = (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY)
    value, variance = joint(result.decisions, sensors, result.aligned_ns + 60 * NS_PER_S)
    return float((value**2 / variance + np.log(variance)).sum())


def best_on_grid(log: Log) -> float:
    """The change of the delay with the least misfit: every 40 ms over +-0.4 s, then every 5 ms, s."""
    coarse = np.arange(-0.4, 0.401, 0.04)
    found = coarse[int(np.argmin([misfit(log, by_s) for by_s in coarse]))]
    fine = found + np.arange(-0.04, 0.041, 0.005)
    return float(fine[int(np.argmin([misfit(log, by_s) for by_s in fine]))])


def estimated(log: Log, by_s: float) -> tuple[Estimated, float]:
    """The state of a drive whose delays are changed, and what it makes of the delay against the importer's, s."""
    config = msgspec.structs.replace(OPEN, estimate=Estimate(gnss_delay=True, delay_sigma_s=0.3))
    found = next(each for each in run(shifted(log, by_s), config).estimates if each.name == "gnss_delay")
    return found, found.value - log.vehicle.gnss_delay_s


@pytest.mark.parametrize(("kind", "name"), DRIVES)
def test_the_delay_is_that_of_a_grid_search(data: Path, kind: str, name: str) -> None:
    """From the importer's delay on, and from none."""
    log = load(kind, data / name)
    best = best_on_grid(log)
    print(f"{name}: importer {log.vehicle.gnss_delay_s:+.3f} s; best on the grid {best:+.3f} s from it")
    for by_s in (0.0, -log.vehicle.gnss_delay_s):
        found, off = estimated(log, by_s)
        print(f"  from {found.given:+.3f} s: {off:+.4f} +- {found.sigma:.4f} s from it, excited {found.excited}")
        assert abs(off - best) < CLOSE_S or not found.excited, (best, found)
