"""Two modes of a pose fix: their spread, the gate that drops where they differ, and what a drive makes of it."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.gating import observed_directions
from fusion.modes import observed_without, spread_of
from fusion.result import Reason, Sensor
from fusion.run import Session, joined, run
from fusion.sensor_models import PoseModel
from fusion.sources import pose_columns
from fusion.state import ROW
from sensors.geodesy import MapFrame
from sensors.pieces import cut
from sensors.records import Log, PoseFix
from sensors.rotation import wrap
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate_drive
from tests.fusion.free import HONEST, Floats
from tests.fusion.scenes import seconds

LIMITS = (0.47, 0.47, 0.01)
T = np.zeros(1, np.int64)
SHARP = np.diag([0.05, 0.03, 0.002]) ** 2


def fix(pose: Floats, first: Floats, second: Floats, weight: float, cov: Floats = SHARP) -> PoseFix:
    """One fix with two modes, the first of this weight."""
    return PoseFix(T, T, pose[None], cov[None], np.stack((first, second))[None], np.array([[weight, 1.0 - weight]]))


@pytest.mark.parametrize("weight", [0.5, 0.8, 0.97])
@pytest.mark.parametrize("share", ["first", "mean", "second"])
def test_spread_is_the_second_moment_of_both_modes_about_the_fix(weight: float, share: str) -> None:
    rng = np.random.default_rng(3)
    first, apart = rng.normal(size=3), np.array([5.0, -3.0, 0.02])
    second, t = first + apart, {"first": 0.0, "mean": 1.0 - weight, "second": 1.0}[share]
    pose = first + t * apart
    moment = weight * np.outer(first - pose, first - pose) + (1 - weight) * np.outer(second - pose, second - pose)
    spread = spread_of(fix(pose, first, second, weight))[0]
    assert np.outer(spread, spread) == pytest.approx(moment, rel=1e-9, abs=1e-12)


def test_modes_on_both_sides_of_south_are_close() -> None:
    first, second = np.array([0.0, 0.0, 3.1]), np.array([0.0, 2.0, -3.1])
    spread = spread_of(fix(first, first, second, 0.75))[0]
    assert spread == pytest.approx(0.5 * np.array([0.0, 2.0, wrap(np.array([-6.2]))[0]]))


def test_one_mode_or_none_has_no_spread() -> None:
    one = PoseFix(T, T, np.zeros((1, 3)), SHARP[None], np.array([[np.zeros(3), [np.nan] * 3]]), np.array([[0.9, 0.0]]))
    assert (spread_of(one) == 0.0).all()
    assert (spread_of(PoseFix(T, T, np.zeros((1, 3)), SHARP[None])) == 0.0).all()


@pytest.mark.parametrize("seed", range(5))
def test_exactly_the_direction_in_which_the_modes_differ_is_dropped(seed: int) -> None:
    """Whatever the direction: what is left of the residual does not change when the other mode is taken instead."""
    rng = np.random.default_rng(seed)
    apart = rng.normal(size=3) * [4.0, 4.0, 0.05]
    spread = np.sqrt(0.5) * apart
    R = SHARP + np.outer(spread, spread)
    found = []
    for residual in (np.array([0.02, -0.01, 0.001]), np.array([0.02, -0.01, 0.001]) + apart):
        H, r = np.zeros((3, ROW)), R.copy()
        H[:, :3] = np.eye(3)
        z = residual.copy()
        assert observed_directions(H, r, z, LIMITS, np.zeros((2, 3, 3)), np.zeros((3, ROW))) == 2
        found.append((z.copy(), np.sqrt(np.diag(r)[:2])))
        # the two that are kept lie across the way between the modes, to the sharpness of the fix
        assert np.abs(H[:2, :3] @ apart / np.sqrt(np.diag(r)[:2])).max() < 0.2
    (one, sigma), (other, _) = found
    assert np.abs((one - other)[:2] / sigma).max() < 0.2
    assert observed_without(R, tuple(spread), LIMITS, np.zeros((2, 3, 3))) == 3


def test_only_what_the_modes_hide_counts_as_theirs() -> None:
    blind = np.diag([0.9, 0.03, 0.002]) ** 2
    along = np.array([3.0, 0.0, 0.0])
    assert observed_without(blind + np.outer(along, along), tuple(along), LIMITS, np.zeros((2, 3, 3))) == 2


FRAME = MapFrame("enu", (48.0, 11.0, 0.0))


def stated(cov: Floats, pose: PoseModel) -> Floats:
    """(3, 3) covariance that the filter uses of a fix at the origin."""
    one = PoseFix(T, T, np.zeros((1, 3)), cov[None])
    result: Floats = pose_columns(one, FRAME, FusionConfig(pose=pose))[3][0]
    return result


def test_quantization_of_the_lattice_is_added_before_inflation() -> None:
    plain = stated(SHARP, PoseModel(inflation=4.0))
    stepped = stated(SHARP, PoseModel(inflation=4.0, step_m=0.125, step_deg=0.125))
    expected = 4.0 * np.array([0.125, 0.125, np.radians(0.125)]) ** 2 / 12.0
    assert np.diag(stepped - plain) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 4, 2.0])
def test_no_direction_of_the_plane_is_below_the_floor(angle: float) -> None:
    """Also across a road that runs askew to the map's axes, where the diagonal shows only how little is known along."""
    c, s = np.cos(angle), np.sin(angle)
    axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    cov = axes @ np.diag([0.2, 0.001, 0.0001]) ** 2 @ axes.T
    used = axes.T @ stated(cov, PoseModel(inflation=1.0)) @ axes
    assert np.sqrt(used[1, 1]) == pytest.approx(0.02, rel=1e-6)
    assert np.sqrt(used[0, 0]) == pytest.approx(0.2, rel=0.01)
    assert np.sqrt(used[2, 2]) == pytest.approx(np.radians(0.05), rel=1e-6)


@pytest.fixture(scope="module")
def log() -> Log:
    """A minute with white errors, GNSS gone after half of it."""
    log = simulate_drive(60.0, 21, scenarios.load("clean")).log
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    kept = [record[seconds(log, record.t_ns) < 30.0] for record in (log.gnss, log.gnss_velocity)]
    return replace(log, gnss=kept[0], gnss_velocity=kept[1])


ROWS = np.arange(400, 450)


def with_modes(log: Log, off: tuple[float, float], weight: float, *, wrong_first: bool) -> Log:
    """ROWS with a second mode so far along and left; wrong_first: that one is the stronger, and the fix."""
    assert log.pose_fixes is not None
    pose, modes, weights = log.pose_fixes.pose.copy(), log.pose_fixes.modes.copy(), log.pose_fixes.weights.copy()
    c, s = np.cos(pose[ROWS, 2]), np.sin(pose[ROWS, 2])
    wrong = pose[ROWS] + np.stack((c * off[0] - s * off[1], s * off[0] + c * off[1], 0.0 * c), axis=-1)
    both = (wrong, pose[ROWS].copy()) if wrong_first else (pose[ROWS].copy(), wrong)
    pose[ROWS], weights[ROWS] = both[0], [weight, 1.0 - weight]
    modes[ROWS] = np.stack(both, axis=1)
    return replace(log, pose_fixes=replace(log.pose_fixes, pose=pose, modes=modes, weights=weights))


@pytest.mark.parametrize("off", [(6.0, 0.0), (0.0, 3.5)], ids=["dash", "lane"])
@pytest.mark.parametrize("wrong_first", [True, False])
def test_the_axis_on_which_two_modes_agree_is_used(log: Log, off: tuple[float, float], wrong_first: bool) -> None:
    result = run(with_modes(log, off, 0.7, wrong_first=wrong_first), HONEST)
    fixes = np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)
    assert (result.decisions.reason[fixes[ROWS]] == Reason.MODES_AGREE).all()
    assert (result.decisions.dof[fixes[ROWS]] == 2).all()
    assert (result.decisions.reason[np.delete(fixes, ROWS)[300:]] == Reason.ACCEPTED).all()
    good = run(log, HONEST).states
    away = np.abs(result.states.llh - good.llh) * [6.4e6, 4.3e6, 1.0]
    assert away[:, :2].max() < 0.2


def test_modes_switched_off_are_not_looked_at(log: Log) -> None:
    config = msgspec.structs.replace(HONEST, pose=msgspec.structs.replace(HONEST.pose, modes=False))
    result = run(with_modes(log, (6.0, 0.0), 0.7, wrong_first=True), config)
    fixes = np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)
    assert (result.decisions.reason[fixes[ROWS]] == Reason.CHI_SQUARE).all()


def test_modes_that_agree_in_nothing_are_rejected(log: Log) -> None:
    """Between them lies a lane, on a road along which nothing is seen, with a yaw that is hardly known."""
    moved = with_modes(log, (0.0, 3.5), 0.7, wrong_first=True)
    assert moved.pose_fixes is not None
    cov = moved.pose_fixes.cov.copy()
    cov[ROWS] += np.diag([0.8, 0.8, 0.05]) ** 2
    yaw = moved.pose_fixes.pose[ROWS, 2]
    left = np.stack((-np.sin(yaw), np.cos(yaw), 0.0 * yaw), axis=-1)
    # blind along the road and in yaw only
    cov[ROWS] -= (0.8**2 - 0.03**2) * left[:, :, None] * left[:, None, :]
    result = run(replace(moved, pose_fixes=replace(moved.pose_fixes, cov=cov)), HONEST)
    fixes = np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)
    assert (result.decisions.reason[fixes[ROWS]] == Reason.MULTI_MODAL).all()
    assert (result.decisions.dof[fixes[ROWS]] == 0).all()


def test_whole_fixes_are_rejected_on_request(log: Log) -> None:
    config = msgspec.structs.replace(HONEST, pose=msgspec.structs.replace(HONEST.pose, partial=False))
    result = run(with_modes(log, (6.0, 0.0), 0.7, wrong_first=False), config)
    fixes = np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)
    assert (result.decisions.reason[fixes[ROWS]] == Reason.MULTI_MODAL).all()


@pytest.mark.parametrize("inflation", [1.0, 4.0])
def test_a_flat_histogram_is_not_observed_whatever_the_inflation(log: Log, inflation: float) -> None:
    """A window's sigma, 0.47 m at the finest level, as its mean is fed back."""
    assert log.pose_fixes is not None
    cov = log.pose_fixes.cov.copy()
    cov[ROWS, :2, :2] = np.eye(2) * 0.46**2
    config = msgspec.structs.replace(HONEST, pose=PoseModel(inflation=inflation))
    result = run(replace(log, pose_fixes=replace(log.pose_fixes, cov=cov)), config)
    fixes = np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)
    assert (result.decisions.reason[fixes[ROWS]] == Reason.PARTLY_ACCEPTED).all()
    assert (result.decisions.dof[fixes[ROWS]] == 1).all()


def test_modes_in_pieces_give_the_same_bits(log: Log) -> None:
    given = with_modes(log, (6.0, 0.0), 0.7, wrong_first=True)
    whole, session = run(given), Session(given.vehicle, given.map_frame)
    parts = joined([*(session.push(piece) for piece in cut(given, 3.7)), session.finish()])
    assert (parts.states.llh == whole.states.llh).all()
    for name in ("reason", "weight", "innovation"):
        np.testing.assert_array_equal(getattr(parts.decisions, name), getattr(whole.decisions, name))
    assert (whole.decisions.reason == Reason.MODES_AGREE).sum() == len(ROWS)
