"""Starts in the middle of real drives: each first state beside the run from the beginning."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fusion.result import FusionResult, Health
from fusion.run import run
from sensors.datasets import load
from sensors.geodesy import enu_from_llh
from sensors.records import Log
from sensors.rotation import wrap, yaw_from_q
from tests.fusion.scenes import without

STARTS = 25
DRIVES = {
    "rtk_drive": ("rtklib", 0.8),
    "imu_gnss_drives/urban-medium-turn-loop-nominal-001": ("imu-gnss-drive", 0.6),
    "imu_gnss_drives/urban-long-turn-loop-nominal-001": ("imu-gnss-drive", 0.6),
    "imu_gnss_drives/parkinglot-maneuvers": ("imu-gnss-drive", 0.8),
}
"""Format, and the largest RMS of yaw difference over stated sigma."""


class Start(NamedTuple):
    """waited_s for the first state; its differences from the whole run: yaw and position over their sigmas."""

    waited_s: float
    yaw: float
    position: float


def start(log: Log, begin_s: float, whole: FusionResult) -> Start | None:
    """A start after so many seconds; None: none within the log."""
    records = {name: getattr(log, name) for name in ("imu", "gnss", "gnss_velocity")}
    result = run(replace(log, **{name: without(record, log, -1e9, begin_s) for name, record in records.items()}))
    _, i, j = np.intersect1d(result.states.t_ns, whole.states.t_ns, return_indices=True)
    if result.aligned_ns is None or not len(i):
        return None
    assert log.imu is not None
    one, other = result.states, whole.states
    yaw = float(wrap(yaw_from_q(one.q_enu_body[i[:1]]) - yaw_from_q(other.q_enu_body[j[:1]]))[0])
    apart = np.hypot(*enu_from_llh(one.llh[i[:1]], other.llh[j[0]])[0, :2])
    waited = (result.aligned_ns - log.imu.t_ns[0]) * 1e-9 - begin_s
    return Start(waited, yaw / one.sigma[i[0], 8], float(apart / np.hypot(*one.sigma[i[0], :2])))


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVES)
def test_starts_in_the_middle_agree_with_the_whole_drive(data: Path, name: str) -> None:
    form, most = DRIVES[name]
    log = load(form, data / name)
    assert log.imu is not None
    log, whole = replace(log, reference=None), run(log)
    length_s = (log.imu.t_ns[-1] - log.imu.t_ns[0]) * 1e-9
    found = [start(log, begin_s, whole) for begin_s in np.linspace(20.0, length_s - 30.0, STARTS)]
    starts = np.array([entry for entry in found if entry is not None])
    waited, yaw, position = starts.T
    rms = float(np.sqrt(np.mean(yaw**2)))
    print(f"{name}: {len(starts)} starts, waited {np.median(waited):.1f} s, yaw {rms:.2f} sigmas rms")
    assert len(starts) >= STARTS - 2
    assert np.median(waited) < 1.5
    assert rms < most
    assert np.abs(yaw).max() < 3.0
    assert np.sqrt(np.mean(position**2)) < 1.0
    assert not (whole.states.health == Health.DIVERGED).any()
    assert whole.restarts == ()


def test_on_the_figure_eight_the_filter_follows_the_gyro_and_the_reference_does_not(data: Path) -> None:
    """From 60 to 105 s: yaw against the gyro's plain integral, scale and drift fitted."""
    log = load("imu-gnss-drive", data / "imu_gnss_drives/parking-lot-figure8-nominal-001")
    assert log.imu is not None
    assert log.reference is not None
    assert log.reference.q_map_body is not None
    t0 = log.imu.t_ns[0]
    t = (log.imu.t_ns - t0) * 1e-9
    rate = log.imu.gyro[:, 2]
    turned = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))]
    states = run(log).states

    def apart(t_ns: np.ndarray, yaw: np.ndarray, delay_s: float) -> float:  # type: ignore[type-arg]
        s = (t_ns - t0) * 1e-9
        inside = (s > 60.0) & (s < 105.0)
        columns = np.column_stack((np.interp(s[inside] + delay_s, t, turned), s[inside], np.ones(inside.sum())))
        fit, *_ = np.linalg.lstsq(columns, np.unwrap(yaw)[inside], rcond=None)
        return float(np.degrees(np.std(columns @ fit - np.unwrap(yaw)[inside])))

    reference = [
        apart(log.reference.t_ns, yaw_from_q(log.reference.q_map_body), d) for d in np.arange(-0.6, 0.61, 0.05)
    ]
    assert apart(states.t_ns, yaw_from_q(states.q_enu_body), 0.0) < 0.5
    assert min(reference) > 10.0
