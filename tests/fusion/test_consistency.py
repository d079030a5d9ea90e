"""Statistics over 50 seeded runs with white measurement noise: NEES of the state and NIS of every sensor."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fusion.result import FusionResult, Sensor
from fusion.run import run
from sensors.geodesy import enu_from_llh
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate_drive
from sensors.simulate.trajectory import Truth
from tests.fusion.free import HONEST, HONEST_FREE, Floats

RUNS = 50
DURATION_S = 100.0
EPOCHS = 900
"""States that every run has: alignment takes a second or two, a stop at the start some more."""
INSIDE = 0.9
"""Part of the epochs whose mean over the runs lies in the two-sided 95 % interval, at least."""
ROWS = {Sensor.GNSS_POSITION: 1000, Sensor.GNSS_VELOCITY: 1000, Sensor.POSE_FIX: 1000, Sensor.WHEEL: 5000}
DOF = {Sensor.GNSS_POSITION: 3, Sensor.GNSS_VELOCITY: 3, Sensor.POSE_FIX: 3, Sensor.WHEEL: 1}


class Runs(NamedTuple):
    """nees_pose, nees_velocity (RUNS, EPOCHS); scores: NIS of each sensor by row of the log (RUNS, rows), NaN: none."""

    nees_pose: Floats
    nees_velocity: Floats
    scores: dict[Sensor, Floats]


def pose_and_velocity_nees(result: FusionResult, truth: Truth) -> tuple[Floats, Floats]:
    """(N,) of position and attitude (6 degrees of freedom) and (N,) of velocity (3, by its sigmas)."""
    states = result.states
    motion = truth.at(states.t_ns)
    datum = states.llh[0]
    place = enu_from_llh(motion.llh, datum) - enu_from_llh(states.llh, datum)
    turn = (Rotation.from_quat(motion.q_enu_body) * Rotation.from_quat(states.q_enu_body).inv()).as_rotvec()
    error = np.hstack((place, turn))
    pose = np.einsum("ni,ni->n", error, np.linalg.solve(states.pose_cov, error[..., None])[..., 0])
    velocity = (((motion.vel_enu - states.vel_enu) / states.sigma[:, 3:6]) ** 2).sum(axis=1)
    return pose, velocity


def scores_by_row(result: FusionResult, truth: Truth, sensor: Sensor) -> Floats:
    """(ROWS[sensor],) NIS of the rows that were scored. A wheel at rest reads exactly zero: only driving counts."""
    decisions = result.decisions
    rows = np.flatnonzero((decisions.sensor == sensor) & (decisions.row < ROWS[sensor]))
    if sensor == Sensor.WHEEL:
        speed = np.linalg.norm(truth.at(decisions.t_ns[rows]).vel_enu, axis=1)
        rows = rows[speed > 0.1]
    scores = np.full(ROWS[sensor], np.nan)
    scores[decisions.row[rows]] = decisions.nis[rows]
    return scores


@pytest.fixture(scope="module", params=["land vehicle", "sensors alone"])
def runs(request: pytest.FixtureRequest) -> Runs:
    """50 drives with and without zero-velocity and non-holonomic updates."""
    config = HONEST if request.param == "land vehicle" else HONEST_FREE
    scene = scenarios.load("clean")
    poses, velocities = [], []
    scores: dict[Sensor, list[Floats]] = {sensor: [] for sensor in ROWS}
    for seed in range(RUNS):
        drive = simulate_drive(DURATION_S, 1000 + seed, scene)
        result = run(drive.log, config)
        pose, velocity = pose_and_velocity_nees(result, drive.truth)
        poses.append(pose[:EPOCHS])
        velocities.append(velocity[:EPOCHS])
        for sensor, values in scores.items():
            values.append(scores_by_row(result, drive.truth, sensor))
    return Runs(np.array(poses), np.array(velocities), {k: np.array(v) for k, v in scores.items()})


def inside(scores: Floats, dof: int) -> Floats:
    """Part of the epochs whose mean over the runs (RUNS, N; NaN: none) lies in the two-sided 95 % interval."""
    runs = np.isfinite(scores).sum(axis=0)
    enough = runs >= RUNS // 2
    low, high = (chi2.ppf(p, dof * runs[enough]) for p in (0.025, 0.975))
    total = np.nansum(scores[:, enough], axis=0)
    assert enough.sum() > 0.8 * scores.shape[1]
    return float(((total > low) & (total < high)).mean())


def test_nees_of_the_pose(runs: Runs) -> None:
    """Position and attitude together, six degrees of freedom."""
    part = inside(runs.nees_pose, 6)
    print(f"pose NEES / 6: {runs.nees_pose.mean() / 6:.3f}; {100 * part:.1f} % of epochs inside")
    assert runs.nees_pose.shape == (RUNS, EPOCHS)
    assert part >= INSIDE
    assert runs.nees_pose.mean() / 6 == pytest.approx(1.0, abs=0.1)


def test_nees_of_the_velocity(runs: Runs) -> None:
    """By its sigmas: the mean is three whatever the correlation, the interval is not exact."""
    part = inside(runs.nees_velocity, 3)
    print(f"velocity NEES / 3: {runs.nees_velocity.mean() / 3:.3f}; {100 * part:.1f} % of epochs inside")
    assert runs.nees_velocity.mean() / 3 == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("sensor", list(ROWS))
def test_nis(runs: Runs, sensor: Sensor) -> None:
    """Innovations of a consistent filter are white with the variance that it states."""
    scores, dof = runs.scores[sensor], DOF[sensor]
    part, mean = inside(scores, dof), np.nanmean(scores) / dof
    print(f"{sensor.name}: mean NIS per degree of freedom {mean:.4f}; {100 * part:.1f} % of epochs inside")
    assert part >= INSIDE
    assert mean == pytest.approx(1.0, abs=0.02)
