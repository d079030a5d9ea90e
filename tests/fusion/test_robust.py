"""Robust kernels: the compiled reweighting against a plain numpy one, and what they do to a drive."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import KERNELS, FusionConfig, Gates, GnssModel
from fusion.gating import innovate, whiten
from fusion.result import Reason, Sensor
from fusion.robust import ITERATIONS, reweigh, weight_of
from fusion.run import run
from fusion.state import ROW
from sensors.errors import EgolocError
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate_drive
from tests.fusion.free import HONEST, Floats, random_covariance
from tests.fusion.rough import fused_errors

HUBER, CAUCHY = 1, 2


def plain_weight(kind: int, r: float, sigmas: float) -> float:
    return min(1.0, sigmas / r) if kind == HUBER else 1.0 / (1.0 + (r / sigmas) ** 2)


def plain(P: Floats, H: Floats, R: Floats, z: Floats, kind: int, sigmas: float) -> tuple[float, Floats, Floats]:
    """Weight, correction and covariance by iterated reweighting, with inverses and a Cholesky factor of R."""
    weight, white = 1.0, np.linalg.inv(np.linalg.cholesky(R))
    for _ in range(ITERATIONS):
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R / weight)
        left = white @ (z - H @ K @ z)
        weight = plain_weight(kind, float(np.sqrt(left @ left / len(z))), sigmas)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R / weight)
    return weight, K @ z, P - K @ H @ P


@pytest.mark.parametrize("kind", [HUBER, CAUCHY])
@pytest.mark.parametrize("dof", [1, 2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_reweighting_equals_plain_numpy(kind: int, dof: int, seed: int) -> None:
    rng = np.random.default_rng([seed, dof])
    P = random_covariance(seed, np.full(ROW, 0.2))
    H, R = np.zeros((3, ROW)), np.zeros((3, 3))
    H[:dof, :9] = rng.standard_normal((dof, 9))
    R[:dof, :dof] = random_covariance(seed + 9, np.full(dof, 0.3))
    z = np.zeros((2, 3))
    z[1, :dof] = rng.normal(0.0, 2.0, dof)
    W, L, white, x = np.zeros((3, ROW)), np.zeros((3, 3)), z[1].copy(), np.zeros(ROW)
    assert innovate(P, H, W, dof, R, L)
    whiten(dof, white, L)
    scaled = R.copy()
    weight = reweigh(P, H, W, dof, scaled, L, white, z, 1, kind, 1.2, x)
    expected, dx, after = plain(P, H[:dof], R[:dof, :dof], z[1, :dof], kind, 1.2)
    assert weight == pytest.approx(expected, rel=1e-9)
    assert scaled[:dof, :dof] * weight == pytest.approx(R[:dof, :dof], rel=1e-9)
    assert W[:dof].T @ white[:dof] == pytest.approx(dx, rel=1e-8, abs=1e-10)
    assert P - W[:dof].T @ W[:dof] == pytest.approx(after, rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("kind", [HUBER, CAUCHY])
def test_weights_fall_with_the_residual(kind: int) -> None:
    r = np.linspace(0.01, 8.0, 50)
    weights = [weight_of(kind, float(x), 2.0) for x in r]
    assert weights == pytest.approx([plain_weight(kind, float(x), 2.0) for x in r])
    assert (np.diff(weights) <= 0.0).all()
    assert weights[0] > 0.99


def test_a_jump_that_the_covariance_explains_weighs_full() -> None:
    """After an outage: the state moves to the fix, what is left of the residual is small."""
    P, H, R = np.eye(ROW) * 25.0, np.zeros((3, ROW)), np.eye(3) * 0.01
    H[:, :3] = np.eye(3)
    z = np.array([[8.0, -6.0, 3.0]])
    W, L, white = np.zeros((3, ROW)), np.zeros((3, 3)), z[0].copy()
    assert innovate(P, H, W, 3, R, L)
    whiten(3, white, L)
    assert reweigh(P, H, W, 3, R, L, white, z, 0, HUBER, 2.0, np.zeros(ROW)) == 1.0
    assert W.T @ white == pytest.approx(np.r_[z[0], np.zeros(ROW - 3)], rel=1e-3)


def robust(kernel: str, **more: float) -> FusionConfig:
    return msgspec.structs.replace(HONEST, gates=Gates(robust=kernel, **more))  # type: ignore[arg-type]


def test_errors_with_heavy_tails_do_less_harm() -> None:
    """GNSS of which a tenth is off by four of its sigmas, all within a wide gate; and weights are recorded."""
    drive = simulate_drive(120.0, 31, scenarios.load("clean"))
    log, rng = replace(drive.log, pose_fixes=None), np.random.default_rng(8)
    assert log.gnss is not None
    off = rng.random(len(log.gnss)) < 0.1
    jump = np.where(off[:, None], rng.choice([-0.08, 0.08], (len(off), 3)), 0.0)
    log = replace(log, gnss=replace(log.gnss, llh=log.gnss.llh + jump * [1.57e-7, 2.35e-7, 1.0]))
    errors = {}
    for kernel in KERNELS:
        config = msgspec.structs.replace(robust(kernel, probability=0.9999999), gnss=GnssModel(inflation=1.0))
        result = run(log, config)
        errors[kernel] = float(np.sqrt((fused_errors(result, drive)[100:, :2] ** 2).mean()))
        rows = result.decisions.sensor == Sensor.GNSS_POSITION
        weight, reason = result.decisions.weight[rows], result.decisions.reason[rows]
        applied = reason == Reason.ACCEPTED
        assert (weight[reason == Reason.CHI_SQUARE] == 0.0).all()
        if kernel == "none":
            assert (weight[applied] == 1.0).all()
        else:
            good = off[result.decisions.row[rows]]
            assert np.median(weight[applied & good]) < 0.7 < np.median(weight[applied & ~good])
    print(errors)
    assert errors["huber"] < 0.95 * errors["none"]
    assert errors["cauchy"] < 0.95 * errors["none"]


def test_an_unknown_kernel_is_one_line() -> None:
    with pytest.raises(EgolocError, match=r"fusion.gates.robust: expected none, huber, cauchy, got 'tukey'"):
        run(simulate_drive(2.0, 1, scenarios.load("clean")).log, robust("tukey"))
