"""Propagation of the covariance against plain numpy; noise per second; symmetry over an hour; gaps in the IMU."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.covariance import Noise, coast, propagate, transition
from fusion.events import OUTPUT
from fusion.filter import Localizer
from fusion.run import run
from fusion.sensor_models import ImuNoise
from fusion.state import A_S, E_ATTITUDE, E_POSITION, E_VELOCITY, E_WHEEL_SCALE, ERROR_SIZE, ROW
from fusion.timeline import noise_of
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from sensors.simulate.imu import ImuSimulation
from sensors.vehicle import Vehicle
from tests.fusion.free import (
    FREE,
    HONEST,
    Floats,
    city,
    core_at,
    exact_imu,
    go,
    go_with,
    grid,
    nav_of,
    random_covariance,
)
from tests.fusion.scenes import with_gap

SIGMAS = np.append(np.repeat([1.0, 0.1, 0.02, 1e-4, 0.05], 3), 0.01)
NOISE = Noise(
    gyro_psd=1e-6, accel_psd=1e-4, gyro_bias_var=1e-8, gyro_bias_rate=2e-10, accel_bias_rate=2e-8, wheel_scale_rate=1e-7
)


def plain(P: Floats, phi: Floats, force: Floats, span: float, noise: Noise) -> Floats:
    """Phi P Phi' + Q in numpy. phi: (16, 16); force: (3,) integral of the specific force, ENU m/s."""
    Q = np.zeros((16, 16))
    qa, qg = noise.accel_psd * span, noise.gyro_psd * span
    x, y, z = force
    minus_skew = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    Q[E_POSITION, E_POSITION] = np.eye(3) * qa * span**2 / 3
    Q[E_POSITION, E_VELOCITY] = Q[E_VELOCITY, E_POSITION] = np.eye(3) * qa * span / 2
    Q[E_VELOCITY, E_VELOCITY] = np.eye(3) * qa
    Q[E_ATTITUDE, E_ATTITUDE] = np.eye(3) * qg
    Q[E_VELOCITY, E_ATTITUDE] = minus_skew * qg / 2
    Q[E_ATTITUDE, E_VELOCITY] = minus_skew.T * qg / 2
    Q[9:15, 9:15] = np.diag(np.repeat([noise.gyro_bias_rate, noise.accel_bias_rate], 3)) * span
    Q[E_WHEEL_SCALE, E_WHEEL_SCALE] = noise.wheel_scale_rate * span
    result: Floats = phi @ P @ phi.T + Q
    return result


def test_propagation_equals_plain_matrices() -> None:
    truth, vehicle = city(20.0), Vehicle()
    t = grid(truth, 20.0, 100)[1500:1511]
    imu = exact_imu(truth, t, vehicle)
    P = random_covariance(0, SIGMAS)
    core = core_at(nav_of(truth.at(t[:1])), imu, P)
    go_with(core, imu, vehicle, np.empty(0, np.int64), OUTPUT)
    assert core.span[0] == pytest.approx(0.1, abs=1e-12)
    upper = np.zeros((9, ROW))
    transition(core.nav, core.earth, core.acc, core.span[0], upper)
    phi = np.eye(ERROR_SIZE)
    phi[:9] = upper
    expected = plain(P, phi, core.acc[A_S].copy(), 0.1, NOISE)
    propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), NOISE)
    assert np.abs(core.P - expected).max() < 1e-14 * np.abs(expected).max()
    assert np.abs((core.P - expected) / np.outer(SIGMAS, SIGMAS)).max() < 1e-11
    assert core.span[0] == 0.0
    assert (core.acc == 0.0).all()


def van_loan(F: Floats, G: Floats, span: float) -> Floats:
    """Q of x' = F x + w with density G, integrated by the midpoint rule in 2000 steps."""
    n = 2000
    total, step = np.zeros_like(F), span / n
    eye = np.eye(len(F))
    for k in range(n):
        s = (k + 0.5) * step
        phi = eye + F * s + F @ F * s**2 / 2 + F @ F @ F * s**3 / 6
        total += phi @ G @ phi.T * step
    return total


def test_process_noise_is_the_integral_of_white_noise() -> None:
    """Each block of Q against van Loan's integral for a constant force; the leading order is what is kept."""
    span, f, noise = 0.1, np.array([1.0, -2.0, 9.8]), noise_of(Vehicle().imu, ImuNoise(noise_scale=1.0))
    F = np.zeros((9, 9))
    F[0:3, 3:6] = np.eye(3)
    F[3:6, 6:9] = [[0, f[2], -f[1]], [-f[2], 0, f[0]], [f[1], -f[0], 0]]
    G = np.diag(np.repeat([0.0, noise.accel_psd, noise.gyro_psd], 3))
    expected = van_loan(F, G, span)
    Q = plain(np.zeros((16, 16)), np.eye(16), f * span, span, noise)[:9, :9]
    sigma = np.sqrt(np.diag(expected))
    missing = np.abs((Q - expected) / np.outer(sigma, sigma))
    # left out: position against attitude, a correlation of g t sqrt(qg / 12 qa) = 1 %
    assert missing.max() < 0.011
    missing[:3, 6:] = missing[6:, :3] = 0.0
    assert missing.max() < 1e-3  # and tilt noise that reaches velocity, (g t)^2 qg / 3 qa


@pytest.mark.parametrize("hz", [200, 400])
def test_noise_is_per_second_not_per_step(hz: int) -> None:
    """100 Hz and faster logs of one drive end with the same sigmas to 2 %, with and without measurements."""
    scene = scenarios.load("clean")
    sigma = {}
    for rate in (100, hz):
        log = simulate(60.0, 4, msgspec.structs.replace(scene, imu=ImuSimulation(rate_hz=rate)))
        sigma[rate] = run(log, HONEST).states.sigma[-1]
    assert np.abs(sigma[hz] / sigma[100] - 1).max() < 0.02


def test_free_sigmas_do_not_depend_on_the_rate() -> None:
    truth, vehicle = city(60.0), Vehicle()
    P = np.diag(SIGMAS**2)
    sigma = {}
    for hz in (100, 200):
        t = grid(truth, 60.0, hz)
        imu = exact_imu(truth, t, vehicle)
        core = core_at(nav_of(truth.at(t[:1])), imu, P)
        go(core, imu, vehicle)
        sigma[hz] = np.sqrt(np.diag(core.P))
    assert np.abs(sigma[200] / sigma[100] - 1).max() < 1e-3


def test_sigmas_do_not_depend_on_how_often_p_is_used() -> None:
    """Propagating at 1, 10 or 100 Hz gives the same sigmas to 1 %: Q composes."""
    truth, vehicle = city(30.0), Vehicle()
    t = grid(truth, 30.0, 100)
    imu = exact_imu(truth, t, vehicle)
    sigma = {}
    for hz in (1, 10, 100):
        core = core_at(nav_of(truth.at(t[:1])), imu, np.diag((0.01 * SIGMAS) ** 2))
        go(core, imu, vehicle, msgspec.structs.replace(FREE, output_hz=float(hz)))
        sigma[hz] = np.sqrt(np.diag(core.P))
    assert np.abs(sigma[10] / sigma[100] - 1).max() < 1e-3
    assert np.abs(sigma[1] / sigma[100] - 1).max() < 1e-2


def test_p_stays_symmetric_and_positive_definite_for_an_hour() -> None:
    """With float and lost GNSS, blind pose fixes, motion updates and a gap; checked in units of the sigmas."""
    log = with_gap(simulate(3600.0, 11, scenarios.load("demo")), 1800.0, 3.0)
    result = run(log, FusionConfig(output_hz=1.0))
    states = result.states
    assert len(states) > 3500
    assert np.isfinite(states.sigma).all()
    assert (states.sigma > 0).all()
    P = states.pose_cov
    unit = P / np.sqrt(np.einsum("ni,nj->nij", *([np.einsum("nii->ni", P)] * 2)))
    assert np.abs(unit - unit.transpose(0, 2, 1)).max() < 1e-12
    smallest = np.linalg.eigvalsh(unit)[:, 0].min()
    print(f"smallest eigenvalue of the pose's correlation over an hour: {smallest:.2e}")
    assert smallest > 1e-6
    assert states.sigma[60:, :3].max() < 30.0


def test_whole_covariance_is_positive_definite_after_ten_minutes() -> None:
    """The full 16 x 16 at its end, through the streaming filter, which shows it."""
    log = simulate(600.0, 12, scenarios.load("demo"))
    localizer = Localizer(log.vehicle, log.map_frame, FusionConfig())
    for record in (log.gnss, log.gnss_velocity, log.pose_fixes, log.imu):
        assert record is not None
        localizer.push(record)
    P = localizer.covariance()
    assert P is not None
    sigma = np.sqrt(np.diag(P))
    unit = P / np.outer(sigma, sigma)
    assert np.abs(unit - unit.T).max() < 1e-12
    assert np.linalg.eigvalsh(unit)[0] > 1e-9


@pytest.mark.parametrize("parts", [2, 7, 300])
def test_coasting_does_not_depend_on_how_a_gap_is_split(parts: int) -> None:
    whole, split = (random_covariance(3, SIGMAS) for _ in range(2))
    coast(whole, 3.0, 2.0, 0.3)
    for _ in range(parts):
        coast(split, 3.0 / parts, 2.0, 0.3)
    assert np.abs(whole - split).max() < 1e-9 * np.abs(whole).max()
    assert np.abs(whole - whole.T).max() < 1e-12 * np.abs(whole).max()


def ends_of_a_gap(samples: int) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """nav and sigmas after so many missing samples at 100 Hz, without and with 24 events inside."""
    truth, vehicle = city(30.0), Vehicle()
    t = grid(truth, 30.0, 100)
    t = np.delete(t, slice(1000, 1000 + samples))
    imu = exact_imu(truth, t, vehicle)
    ends = []
    inside: NDArray[np.int64] = t[999] + np.arange(1, 25) * 100_000_001
    for at in (np.empty(0, np.int64), inside):
        core = core_at(nav_of(truth.at(t[:1])), imu, np.diag(SIGMAS**2))
        go_with(core, imu[:1001], vehicle, np.sort(np.append(at, t[1000])), OUTPUT)
        ends.append((core.nav.copy(), np.sqrt(np.diag(core.P))))
    return ends


def test_events_inside_a_long_gap_do_not_change_where_it_ends() -> None:
    plain, split = ends_of_a_gap(350)
    assert np.abs(plain[0] - split[0])[3:].max() == 0.0  # constant velocity and attitude
    assert np.abs(plain[0] - split[0])[:2].max() * 6.4e6 < 1e-3
    assert np.abs(plain[1] / split[1] - 1).max() < 1e-9


def test_events_inside_a_bridged_gap_hardly_change_where_it_ends() -> None:
    """One step over 2.5 s and 25 small ones differ by the integrator's truncation: far below the gap's sigmas."""
    plain, split = ends_of_a_gap(249)
    assert np.abs(plain[0] - split[0])[3:6].max() < 1e-3  # m/s, of some 5
    assert np.abs(plain[0] - split[0])[:2].max() * 6.4e6 < 1e-2
    assert np.abs(plain[1] / split[1] - 1).max() < 0.05


def test_noise_scale_multiplies_the_white_noise_only() -> None:
    spec = Vehicle().imu
    one, two = (noise_of(spec, ImuNoise(noise_scale=scale)) for scale in (1.0, 2.0))
    assert two.gyro_psd == pytest.approx(4 * one.gyro_psd)
    assert two.accel_psd == pytest.approx(4 * one.accel_psd)
    assert two[2:] == one[2:]
    # 0.1 deg/sqrt(h) is 0.1 deg after an hour
    assert np.degrees(np.sqrt(one.gyro_psd * 3600)) == pytest.approx(spec.gyro_noise_deg_per_sqrt_h)
    assert np.sqrt(one.accel_psd * 3600) == pytest.approx(spec.accel_noise_m_per_s_per_sqrt_h)


def test_a_scale_error_of_the_accelerometer_counts_where_the_velocity_changes() -> None:
    """Five metres a second that are gained make a share of 1 % uncertain by 0.05 m/s; at rest nothing does."""
    flawed = msgspec.structs.replace(Vehicle().imu, accel_scale_ppm=8000.0, accel_misalignment_deg=np.degrees(0.006))
    plain, told = (noise_of(spec, ImuNoise()) for spec in (Vehicle().imu, flawed))
    truth, t = city(1.0), np.array([0], np.int64)
    nav = nav_of(truth.at(truth.start_ns + t))
    grown = []
    for gained in (0.0, 5.0):
        P = []
        for noise in (plain, told):
            core = core_at(nav, exact_imu(truth, grid(truth, 1.0, 100)[:2], Vehicle()), np.zeros((16, 16)))
            core.acc[A_S], core.span[0] = (0.6 * gained, -0.8 * gained, 9.8), 1.0
            propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), noise)
            P.append(core.P.copy())
        grown.append(np.sqrt(np.diag(P[1] - P[0])))
    assert grown[0] == pytest.approx(np.zeros(16), abs=1e-9)
    assert grown[1] == pytest.approx(np.r_[0.0, 0.0, 0.0, 0.05, 0.05, np.zeros(11)], abs=1e-9)


def test_waiting_makes_no_bias_known() -> None:
    """Without measurements the sigmas of the biases only grow, by the drift's driving noise."""
    truth, vehicle = city(600.0), Vehicle()
    t = grid(truth, 600.0, 20)
    imu = exact_imu(truth, t, vehicle)
    core = core_at(nav_of(truth.at(t[:1])), imu, np.diag(SIGMAS**2))
    go(core, imu, vehicle)
    noise = noise_of(vehicle.imu, FREE.imu)
    grown = SIGMAS[9:15] ** 2 + np.repeat([noise.gyro_bias_rate, noise.accel_bias_rate], 3) * 600
    assert np.diag(core.P)[9:15] == pytest.approx(grown, rel=1e-9)
