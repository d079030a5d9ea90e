"""filterpy as an independent oracle: the same Phi, Q, H and R give the same states and covariances."""

import msgspec
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from fusion.config import Gates
from fusion.covariance import propagate, transition
from fusion.events import OUTPUT
from fusion.gating import correct, innovate, whiten
from fusion.state import A_S, E_ATTITUDE, ERROR_SIZE, LLH, ROW, VELOCITY, Core
from fusion.timeline import noise_of
from sensors.records import GnssFix, GnssVelocity, Log
from sensors.rotation import q_from_rpy
from sensors.simulate.drive import DriveConfig, city_truth
from sensors.simulate.gnss import displaced
from sensors.vehicle import ImuSpec, Vehicle
from tests.fusion.free import (
    FREE,
    HONEST,
    Floats,
    at_rest,
    core_at,
    exact_imu,
    go,
    go_with,
    grid,
    minus,
    nav_of,
    random_covariance,
)
from tests.fusion.test_covariance import plain

KNOWN_ATTITUDE = ImuSpec(gyro_noise_deg_per_sqrt_h=0.0, gyro_bias_instability_deg_per_h=0.0)
"""Without gyro errors the attitude is known and the filter's problem is linear in position, velocity and bias."""
CONFIG = msgspec.structs.replace(
    FREE,
    gates=Gates(use=False),
    gnss=HONEST.gnss,
)
POSITION_SIGMA, VELOCITY_SIGMA = 1e-4, 1e-4


def step(core: Core, vehicle: Vehicle) -> tuple[Floats, Floats]:
    """Phi and Q (16, 16) over what the core has accumulated, in plain numpy; the core's P goes along."""
    noise = noise_of(vehicle.imu, CONFIG.imu)
    span, upper = float(core.span[0]), np.zeros((9, ROW))
    transition(core.nav, core.earth, core.acc, span, upper)
    phi = np.eye(ERROR_SIZE)
    phi[:9] = upper
    Q = plain(np.zeros((ERROR_SIZE, ERROR_SIZE)), phi, core.acc[A_S].copy(), span, noise)
    propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), noise)
    return phi, Q


def gnss_along(every: NDArray[np.int64], navs: Floats) -> Log:
    """GNSS positions and velocities at every time of navs (N, 17), with white errors."""
    rng, n = np.random.default_rng(3), len(every)
    cov = np.broadcast_to(np.diag([1.0, 2.0, 3.0]), (n, 3, 3))
    llh = displaced(navs[:, LLH], POSITION_SIGMA * rng.standard_normal((n, 3)))
    vel = navs[:, VELOCITY] + VELOCITY_SIGMA * rng.standard_normal((n, 3))
    fixes = GnssFix(every, every, llh, cov * POSITION_SIGMA**2, np.full(n, 4, np.int8))
    return Log(gnss=fixes, gnss_velocity=GnssVelocity(every, every, vel, cov * VELOCITY_SIGMA**2))


def test_linear_case_equals_filterpy() -> None:
    """100 s of GNSS positions and velocities at 10 Hz: filterpy estimates the deviation from a free inertial run.

    The attitude is known and constant. Deviations are a tenth of a millimetre and of mm/s, so that what Phi leaves out
    (Coriolis of second order: 1e-6 of a velocity's deviation) stays below 1e-9; near latitude and longitude zero a
    double resolves the place to 1e-11 m.
    """
    vehicle = Vehicle(imu=KNOWN_ATTITUDE)
    t = 10**18 + np.arange(10_001) * 10_000_000
    first = np.concatenate(([0.003, 0.004, 50.0], np.zeros(3), q_from_rpy(0.1, -0.2, 2.3)[0], np.zeros(7)))
    imu, every = at_rest(first, t, push=np.array([0.3, -0.1, 0.05])), t[10::10]
    free = core_at(first, imu)
    navs, steps = [], []
    for time in every:
        go_with(free, imu[imu.t_ns <= time], vehicle, np.empty(0, np.int64), OUTPUT)
        navs.append(free.nav.copy())
        steps.append(step(free, vehicle))
    log = gnss_along(every, np.array(navs))

    P = np.diag(np.append(np.repeat([1e-4, 1e-4, 0.0, 0.0, 1e-4], 3), 0.0) ** 2)
    filtered = core_at(first, imu, P)
    rec, _ = go(filtered, imu, vehicle, CONFIG, log)
    oracle = KalmanFilter(dim_x=ERROR_SIZE, dim_z=6)
    oracle.x, oracle.P, oracle.H = np.zeros(ERROR_SIZE), P.copy(), np.eye(6, ERROR_SIZE)
    oracle.R = np.kron(np.diag([POSITION_SIGMA**2, VELOCITY_SIGMA**2]), np.diag([1.0, 2.0, 3.0]))
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    states, sigmas = [], []
    for k, (phi, Q) in enumerate(steps):
        oracle.predict(F=phi, Q=Q)
        measured = np.concatenate((log.gnss.llh[k], log.gnss_velocity.vel_enu[k], navs[k][6:]))
        oracle.update(minus(measured, navs[k])[:6])
        states.append(minus(np.append(rec.nav[k], 0.0), navs[k]) - oracle.x)
        sigmas.append(rec.sigma_state[k] - np.sqrt(np.diag(oracle.P))[:15])
    assert rec.filled[0] == len(every)
    difference = np.abs(states).max(axis=0)
    place, speed = difference[:3].max(), difference[3:6].max()
    print(f"largest difference to filterpy: position {place:.1e} m, velocity {speed:.1e} m/s")
    assert difference.max() < 1e-9
    assert np.abs(oracle.x[:3]).max() > 1e-6  # the oracle did move
    assert np.abs(sigmas).max() < 1e-12
    assert np.abs(filtered.P - oracle.P).max() < 1e-9 * np.abs(oracle.P).max()


@pytest.mark.parametrize("dof", [1, 2, 3])
def test_updates_equal_filterpy_over_a_drive(dof: int) -> None:
    """All 16 states, attitude included, 500 updates: each correction and the covariance; both get the same reset."""
    vehicle, seconds = Vehicle(), 50.0
    truth = city_truth(seconds, 7, DriveConfig())
    t = grid(truth, seconds, 100)
    imu = exact_imu(truth, t, vehicle)
    sigma = np.append(np.repeat([1.0, 0.3, 0.02, 1e-4, 0.05], 3), 0.01)
    core = core_at(nav_of(truth.at(t[:1])), imu, random_covariance(8, sigma))
    oracle = KalmanFilter(dim_x=ERROR_SIZE, dim_z=dof)
    oracle.P = core.P.copy()
    rng = np.random.default_rng(9)
    largest = np.zeros(2)
    for time in t[10::10]:
        go_with(core, imu[imu.t_ns <= time], vehicle, np.empty(0, np.int64), OUTPUT)
        phi, Q = step(core, vehicle)
        oracle.x = np.zeros((ERROR_SIZE, 1))
        oracle.predict(F=phi, Q=Q)
        H = rng.standard_normal((dof, ERROR_SIZE)) / sigma * (rng.random((dof, ERROR_SIZE)) < 0.4)
        root = rng.standard_normal((dof, dof))
        R = root @ root.T + 0.5 * np.eye(dof)
        z = rng.standard_normal(dof)
        oracle.update(z[:, None], R=R, H=H)
        dx, nis = updated(core, H, R, z)
        scale = np.sqrt(np.diag(oracle.P))
        largest = np.maximum(largest, (np.abs(dx - oracle.x[:, 0]) / scale).max())
        y = np.linalg.solve(oracle.S, z)
        assert nis == pytest.approx(float(z @ y), rel=1e-9)
        oracle.P = turned(oracle.P, dx[E_ATTITUDE])
        difference = np.abs(core.P - oracle.P) / np.outer(scale, scale)
        assert difference.max() < 1e-9
    print(f"{dof} rows: largest correction difference {largest[0]:.1e} sigma")
    assert largest[0] < 1e-9
    assert np.isfinite(core.nav).all()
    assert (np.abs(core.nav[LLH]) < 10 * truth.at(t[:1]).llh[0]).all()


def updated(core: Core, H: Floats, R: Floats, z: Floats) -> tuple[Floats, float]:
    """One update of the core by the kernels: the correction (16,) and the normalized innovation squared."""
    dof = len(z)
    core.H[:], core.R[:], core.residual[:] = 0.0, 0.0, 0.0
    core.H[:dof, :ERROR_SIZE], core.R[:dof, :dof], core.residual[:dof] = H, R, z
    assert innovate(core.P, core.H, core.W, dof, core.R, core.L)
    nis = whiten(dof, core.residual, core.L)
    correct(core.nav, core.earth, core.P, core.W, core.dx, core.residual, dof)
    return core.dx[:ERROR_SIZE].copy(), nis


def turned(P: Floats, angle: Floats) -> Floats:
    """P after the reset of an attitude error (3,)."""
    x, y, z = 0.5 * angle
    G = np.eye(ERROR_SIZE)
    G[E_ATTITUDE, E_ATTITUDE] += [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    result: Floats = G @ P @ G.T
    return result
