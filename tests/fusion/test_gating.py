"""Covariance gate and chi-square gate: what is kept, what is dropped, and how often."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion.config import FusionConfig, Gates
from fusion.gating import diagonalize, innovate, observed_directions, whiten
from fusion.result import Decisions, Reason, Sensor
from fusion.run import run
from fusion.sensor_models import GnssModel
from fusion.state import ROW
from fusion.timeline import parameters
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate_drive
from sensors.vehicle import Vehicle
from tests.fusion.free import HONEST, Floats, random_covariance

LIMITS = (0.5, 0.3, 0.01)
SEEN = np.array([0.05, 0.03, 0.002])
"""Sigmas along, left and of yaw, well inside LIMITS."""


def reduced(R: Floats, residual: Floats, H: Floats) -> tuple[int, Floats, Floats, Floats]:
    """Directions kept, and R, residual and H after the covariance gate."""
    r, z, h = R.copy(), residual.copy(), np.zeros((3, ROW))
    h[:] = H
    kept = observed_directions(h, r, z, LIMITS, np.zeros((2, 3, 3)), np.zeros((3, ROW)))
    return kept, r, z, h


def rows() -> Floats:
    """H (3, 16) of a pose fix that looks at position and attitude."""
    H = np.zeros((3, ROW))
    H[:, :9] = np.random.default_rng(1).standard_normal((3, 9))
    return H


def corrected(P: Floats, H: Floats, R: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Correction and covariance of a plain Kalman update."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return K @ z, P - K @ H @ P


def test_observed_fix_is_left_as_it_is() -> None:
    R, z, H = random_covariance(2, SEEN), np.array([0.1, 0.2, 0.001]), rows()
    kept, r, residual, h = reduced(R, z, H)
    assert kept == 3
    assert (r == R).all()
    assert (residual == z).all()
    assert (h == H).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_unobserved_axis_is_dropped_and_the_others_are_kept(axis: int) -> None:
    sigma = SEEN.copy()
    sigma[axis] = 3.0 * LIMITS[axis]
    z, H = np.array([0.1, 0.2, 0.001]), rows()
    kept, r, residual, h = reduced(np.diag(sigma**2), z, H)
    others = [i for i in range(3) if i != axis]
    assert kept == 2
    order = np.argsort([np.abs(residual[0] - z[i] / LIMITS[i]) for i in others])
    for row, i in enumerate(others[k] for k in order):
        sign = np.sign(residual[row] * z[i])
        assert residual[row] == pytest.approx(sign * z[i] / LIMITS[i], rel=1e-12)
        assert h[row] == pytest.approx(sign * H[i] / LIMITS[i], rel=1e-12)
        assert r[row, row] == pytest.approx((sigma[i] / LIMITS[i]) ** 2, rel=1e-12)
    assert (h[2] == 0.0).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("dropped", [1, 2])
def test_rank_reduced_update_equals_infinite_variance(seed: int, dropped: int) -> None:
    """Skewed covariances: the unobserved directions lie anywhere in the space of (lon, lat, yaw) over the limits."""
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    values = np.array([0.01, 0.03, 0.1])
    values[:dropped] = 4.0
    D = np.diag(LIMITS)
    R = D @ axes @ np.diag(values) @ axes.T @ D
    blind = np.where(values > 1.0, 1e9, values)
    R_blind = D @ axes @ np.diag(blind) @ axes.T @ D
    z, H = np.array([0.2, -0.1, 0.003]), rows()
    P = random_covariance(seed + 10, np.append(np.repeat([0.2, 0.1, 0.01, 1e-4, 0.05], 3), 0.01))
    kept, r, residual, h = reduced(R, z, H)
    assert kept == 3 - dropped
    dx, after = corrected(P, h[:kept], r[:kept, :kept], residual[:kept])
    dx_blind, after_blind = corrected(P, H, R_blind, z)
    sigma = np.sqrt(np.diag(P))
    assert np.abs((dx - dx_blind) / sigma).max() < 1e-6
    assert np.abs((after - after_blind) / np.outer(sigma, sigma)).max() < 1e-6


def test_nothing_observed_keeps_nothing() -> None:
    kept, *_ = reduced(np.diag((2.0 * np.array(LIMITS)) ** 2), np.ones(3), rows())
    assert kept == 0


@pytest.mark.parametrize("seed", range(20))
def test_eigenvalues_and_vectors_equal_numpy(seed: int) -> None:
    """Also near-degenerate and badly scaled matrices: what is kept must not hang on the solver."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-4, 4, 3)
    A = random_covariance(seed, scale) if seed % 3 else np.diag(scale) + 1e-9 * np.ones((3, 3))
    eigen = np.zeros((2, 3, 3))
    eigen[0] = A
    diagonalize(eigen)
    values, vectors = np.diag(eigen[0]), eigen[1]
    assert np.sort(values) == pytest.approx(np.linalg.eigvalsh(A), rel=1e-9, abs=1e-15 * np.abs(A).max())
    assert vectors.T @ vectors == pytest.approx(np.eye(3), abs=1e-12)
    assert vectors @ np.diag(values) @ vectors.T == pytest.approx(A, abs=1e-13 * np.abs(A).max())


@pytest.mark.parametrize("dof", [1, 2, 3])
def test_thresholds_follow_probability_and_degrees_of_freedom(dof: int) -> None:
    config = FusionConfig(gates=Gates(probability=0.99))
    assert parameters(Vehicle(), config).gate[dof - 1] == pytest.approx(chi2.ppf(0.99, dof))
    off = parameters(Vehicle(), FusionConfig(gates=Gates(use=False)))
    assert off.gate == (np.inf, np.inf, np.inf)


@pytest.mark.parametrize("dof", [1, 2, 3])
def test_consistent_innovations_pass_at_the_stated_probability(dof: int) -> None:
    """20,000 draws from N(0, H P H' + R) against the 95 % threshold: within four standard deviations of 95 %."""
    P, H, rng = random_covariance(4, np.ones(ROW)), np.zeros((3, ROW)), np.random.default_rng(dof)
    H[:dof] = rng.standard_normal((dof, ROW))
    R = np.zeros((3, 3))
    R[:dof, :dof] = random_covariance(5, np.ones(dof))
    W, L = np.zeros((3, ROW)), np.zeros((3, 3))
    assert innovate(P, H, W, dof, R, L)
    S = H[:dof] @ P @ H[:dof].T + R[:dof, :dof]
    draws = rng.multivariate_normal(np.zeros(dof), S, 20_000)
    scores = np.array([whiten(dof, np.append(z, np.full(3 - dof, 7.0)), L) for z in draws])
    passed = float((scores <= chi2.ppf(0.95, dof)).mean())
    print(f"{dof} degrees of freedom: {passed:.4f} pass at 0.95")
    assert abs(passed - 0.95) < 4 * np.sqrt(0.95 * 0.05 / len(draws))
    exact = np.einsum("ni,ni->n", draws, np.linalg.solve(S, draws.T).T)
    assert scores == pytest.approx(exact, rel=1e-9)


def of(decisions: Decisions, sensor: Sensor) -> NDArray[np.int8]:
    """Reasons of one sensor's decisions."""
    return decisions.reason[decisions.sensor == sensor]


@pytest.fixture(scope="module")
def log() -> Log:
    """A minute with white errors, long enough to converge."""
    return simulate_drive(60.0, 21, scenarios.load("clean")).log


def moved_fix(log: Log, row: int, along: float = 0.0, left: float = 0.0, yaw: float = 0.0) -> Log:
    """The log with one pose fix displaced in vehicle axes."""
    assert log.pose_fixes is not None
    pose = log.pose_fixes.pose.copy()
    c, s = np.cos(pose[row, 2]), np.sin(pose[row, 2])
    pose[row] += [c * along - s * left, s * along + c * left, yaw]
    return replace(log, pose_fixes=replace(log.pose_fixes, pose=pose))


def widened(log: Log, row: int, sigmas: tuple[float, float, float]) -> Log:
    """The log with other sigmas (along, left, yaw) for one pose fix."""
    assert log.pose_fixes is not None
    cov = log.pose_fixes.cov.copy()
    c, s = np.cos(log.pose_fixes.pose[row, 2]), np.sin(log.pose_fixes.pose[row, 2])
    axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    cov[row] = axes @ np.diag(np.square(sigmas)) @ axes.T
    return replace(log, pose_fixes=replace(log.pose_fixes, cov=cov))


ROWS = (300, 400, 500)
POSE_ONLY = msgspec.structs.replace(HONEST, gnss=GnssModel(use=False))


@pytest.mark.parametrize("config", [HONEST, POSE_ONLY], ids=["with gnss", "pose fixes alone"])
def test_fix_one_lane_off_is_rejected(log: Log, config: FusionConfig) -> None:
    good = run(log, config).states
    for row in ROWS:
        result = run(moved_fix(log, row, left=3.5), config)
        fixes = of(result.decisions, Sensor.POSE_FIX)
        assert fixes[row] == Reason.CHI_SQUARE
        assert (np.delete(fixes, row) != Reason.CHI_SQUARE)[ROWS[0] - 50 :].mean() > 0.99
        k = int(np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)[row])
        assert result.decisions.nis[k] > result.decisions.threshold[k]
        assert result.decisions.innovation[k, 1] == pytest.approx(3.5, abs=0.3)
        assert result.decisions.moved_m[k] == 0.0
        away = np.abs(result.states.llh[-1] - good.llh[-1]) * [6.4e6, 4.3e6, 1.0]
        assert away[:2].max() < 0.01  # pose fixes say nothing of height


def test_consistent_fixes_pass_and_jumps_of_each_axis_are_rejected(log: Log) -> None:
    fixes = of(run(log, HONEST).decisions, Sensor.POSE_FIX)
    assert (fixes == Reason.CHI_SQUARE).mean() < 1e-3  # the default lets 0.01 % of correct ones fail
    for jump in ({"along": 1.5}, {"left": 0.5}, {"yaw": np.radians(2.0)}):
        assert of(run(moved_fix(log, ROWS[1], **jump), HONEST).decisions, Sensor.POSE_FIX)[ROWS[1]] == Reason.CHI_SQUARE


def test_gate_switched_off_takes_everything(log: Log) -> None:
    config = msgspec.structs.replace(HONEST, gates=Gates(use=False))
    assert of(run(moved_fix(log, ROWS[0], left=3.5), config).decisions, Sensor.POSE_FIX)[ROWS[0]] == Reason.ACCEPTED


def test_blind_direction_is_dropped_and_cannot_move_the_state(log: Log) -> None:
    """The mean along the road is 5 m off where the histogram does not see it: the rest of the fix is used as before."""
    row = ROWS[0]
    blind = widened(log, row, (0.6, 0.03, np.radians(0.13)))
    results = [run(moved_fix(blind, row, along=off), HONEST) for off in (0.0, 5.0)]
    for result in results:
        k = int(np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)[row])
        assert result.decisions.reason[k] == Reason.PARTLY_ACCEPTED
        assert result.decisions.dof[k] == 2
        assert result.decisions.threshold[k] == pytest.approx(chi2.ppf(0.9999, 2))
        assert np.isnan(result.decisions.innovation[k, 2])
    apart = np.abs(results[0].states.llh - results[1].states.llh) * [6.4e6, 4.3e6, 1.0]
    assert apart.max() < 0.05  # the estimated heading differs from the fix's by a tenth of a degree


def test_fix_that_sees_nothing_is_recorded_as_such(log: Log) -> None:
    result = run(widened(log, ROWS[0], (3.0, 3.0, 0.2)), HONEST)
    k = int(np.flatnonzero(result.decisions.sensor == Sensor.POSE_FIX)[ROWS[0]])
    assert result.decisions.reason[k] == Reason.COVARIANCE
    assert result.decisions.dof[k] == 0
    assert np.isnan(result.decisions.nis[k])
