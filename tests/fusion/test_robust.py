"""Robust kernels: the compiled reweighting against a plain numpy one, and what they do to a drive."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import KERNELS, FusionConfig, Gates
from fusion.gating import innovate, whiten
from fusion.result import Reason, Sensor
from fusion.robust import ITERATIONS, reweigh, weight_of
from fusion.run import run
from fusion.state import ROW
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.records import Log
from sensors.rotation import yaw_from_q
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from sensors.simulate.gnss import displaced
from sensors.simulate.reference import attitude_in_map
from tests.fusion.free import Floats, random_covariance
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


def robust(kernel: str) -> FusionConfig:
    return FusionConfig(gates=Gates(robust=kernel))  # type: ignore[arg-type]


def with_tails(drive: Drive, rng: np.random.Generator, share: float) -> tuple[Log, dict[Sensor, NDArray[np.bool_]]]:
    """GNSS and pose fixes with white errors as they claim, but for a share of them whose sigma is five times that; and
    which these are."""
    log, tails = drive.log, {}
    assert log.gnss is not None
    assert log.pose_fixes is not None
    assert log.map_frame is not None
    errors = {}
    for sensor, count in ((Sensor.GNSS_POSITION, len(log.gnss)), (Sensor.POSE_FIX, len(log.pose_fixes))):
        tails[sensor] = rng.random(count) < share
        errors[sensor] = rng.standard_normal((count, 3)) * np.where(tails[sensor], 5.0, 1.0)[:, None]
    sigma = np.sqrt(np.diagonal(log.gnss.cov_enu, axis1=1, axis2=2))
    place = drive.truth.at(log.gnss.t_ns).place_of(log.vehicle.gnss_lever_arm)
    gnss = replace(log.gnss, llh=displaced(place, sigma * errors[Sensor.GNSS_POSITION]))
    motion = drive.truth.at(log.pose_fixes.t_ns)
    yaw = yaw_from_q(attitude_in_map(motion, log.map_frame))
    place = map_from_llh(log.map_frame, motion.place_of(log.vehicle.pose_lever_arm))[:, :2]
    root = np.linalg.cholesky(log.pose_fixes.cov)
    pose = np.column_stack((place, yaw)) + (root @ errors[Sensor.POSE_FIX][..., None])[..., 0]
    return replace(log, gnss=gnss, pose_fixes=replace(log.pose_fixes, pose=pose)), tails


@pytest.fixture(scope="module")
def drives() -> list[Drive]:
    return [simulate_drive(120.0, seed, scenarios.load("clean")) for seed in (41, 42, 43)]


def rms(drives: list[Drive], kernel: str, share: float, without: str) -> float:
    """Horizontal error over all drives from 15 s on, m. without: a record that they lack."""
    total = []
    for seed, drive in enumerate(drives):
        log, _ = with_tails(drive, np.random.default_rng([seed, 8]), share)
        if without == "gnss":
            log = replace(log, gnss=None, gnss_velocity=None)
        elif without == "pose_fixes":
            log = replace(log, pose_fixes=None)
        total.append(fused_errors(run(log, robust(kernel)), drive)[150:, :2])
    return float(np.sqrt((np.concatenate(total) ** 2).mean()))


@pytest.mark.parametrize("without", ["", "gnss", "pose_fixes"])
def test_tails_of_every_sensor_do_less_harm(drives: list[Drive], without: str) -> None:
    """A tenth with five times the sigma: what is not far enough out for the gate is far enough for a kernel."""
    off = {kernel: rms(drives, kernel, 0.1, without) for kernel in KERNELS}
    print(f"without {without or 'none'}: " + ", ".join(f"{kernel} {100 * off[kernel]:.2f} cm" for kernel in KERNELS))
    assert off["huber"] < 0.95 * off["none"]
    assert off["cauchy"] < 0.9 * off["none"]


def test_where_errors_are_normal_a_kernel_costs_little(drives: list[Drive]) -> None:
    off = {kernel: rms(drives, kernel, 0.0, "") for kernel in KERNELS}
    print(", ".join(f"{kernel} {100 * off[kernel]:.2f} cm" for kernel in KERNELS))
    assert max(off["huber"], off["cauchy"]) < 1.05 * off["none"]


@pytest.mark.parametrize("kernel", KERNELS)
def test_weights_are_recorded(drives: list[Drive], kernel: str) -> None:
    log, tails = with_tails(drives[0], np.random.default_rng(5), 0.1)
    decisions = run(log, robust(kernel)).decisions
    for sensor, far in tails.items():
        rows = decisions.sensor == sensor
        weight, reason, off = decisions.weight[rows], decisions.reason[rows], far[decisions.row[rows]]
        applied = reason == Reason.ACCEPTED
        assert (weight[reason == Reason.CHI_SQUARE] == 0.0).all()
        assert (applied & off).sum() > 20
        if kernel == "none":
            assert (weight[applied] == 1.0).all()
        else:
            assert np.median(weight[applied & off]) < 0.75 * np.median(weight[applied & ~off])


def test_an_unknown_kernel_is_one_line() -> None:
    with pytest.raises(EgolocError, match=r"fusion.gates.robust: expected none, huber, cauchy, got 'tukey'"):
        run(simulate_drive(2.0, 1, scenarios.load("clean")).log, robust("tukey"))
