"""Every Jacobian of the filter against finite differences: transition, measurements, injection, reset."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion._linalg import attitude
from fusion.covariance import transition
from fusion.events import OUTPUT
from fusion.gating import inject, reset
from fusion.measurements import body_velocity, gnss_position, gnss_velocity, pose_fix, wheel_speed, yaw_row
from fusion.measurements import wrap as wrap_kernel
from fusion.sources import pose_columns
from fusion.state import E_ATTITUDE, E_WHEEL_SCALE, ERROR_SIZE, GYRO_BIAS, LLH, QUATERNION, ROW, VELOCITY, WHEEL_SCALE
from sensors.geodesy import MapFrame, map_from_llh, utm_frame
from sensors.records import Imu, PoseFix
from sensors.rotation import matrix_from_q, q_from_rpy, yaw_from_q
from sensors.simulate.reference import attitude_in_map
from sensors.simulate.trajectory import Motion
from sensors.vehicle import Vehicle
from tests.fusion.free import HONEST, core_at, go_with, minus, plus

Floats = NDArray[np.float64]

SCALE = np.append(np.repeat([1.0, 0.1, 1e-3, 1e-5, 1e-2], 3), 1e-3)
"""Errors of ordinary size: m, m/s, rad, rad/s, m/s^2, -. Jacobians are compared in these units."""
BIASES = [1e-3, -2e-3, 1.5e-3, 0.02, -0.03, 0.05, 0.004]
NAV = np.concatenate(([0.84, 0.2, 560.0], [18.0, -12.0, 1.5], q_from_rpy(0.12, -0.08, 2.3)[0], BIASES))
GYRO = np.array([0.11, -0.07, 0.45])
ARM = (0.9, -0.6, 1.3)
NONE = np.empty(0, np.int64)


def shaken(seconds: float) -> Imu:
    """100 Hz samples of a body that turns about every axis and accelerates."""
    t = np.arange(round(seconds * 100) + 1) / 100
    phase = np.array([0.3, 1.1, 2.0])
    gyro = np.array([0.2, 0.15, 0.5]) * np.sin(2 * np.pi * np.array([1.3, 0.9, 0.4]) * t[:, None] + phase)
    push = np.array([2.0, 3.0, 1.5]) * np.sin(2 * np.pi * np.array([0.7, 0.5, 1.7]) * t[:, None] + 2 * phase)
    t_ns = 10**18 + np.rint(t * 1e9).astype(np.int64)
    return Imu(t_ns, t_ns, gyro, push + np.array([0.0, 0.0, 9.8]))


def propagated(imu: Imu, nav: Floats) -> tuple[Floats, Floats]:
    """State (17,) after the samples and the transition (9, 16) that was summed over them."""
    core = core_at(nav, imu)
    go_with(core, imu, Vehicle(), NONE, OUTPUT)
    phi = np.zeros((9, ROW))
    transition(core.nav, core.earth, core.acc, core.span[0], phi)
    return core.nav, phi


def transitions(seconds: float, size: float) -> tuple[Floats, Floats]:
    """The filter's transition and that of central differences of the strapdown (9, 16), in units of SCALE."""
    imu = shaken(seconds)
    nominal, phi = propagated(imu, NAV)
    found = np.empty((9, ERROR_SIZE))
    for i, step in enumerate(np.diag(size * SCALE)):
        ahead, behind = (propagated(imu, plus(NAV, sign * step))[0] for sign in (1.0, -1.0))
        found[:, i] = (minus(ahead, nominal) - minus(behind, nominal))[:9] / (2 * size)
    return phi * SCALE / SCALE[:9, None], found / SCALE[:9, None]


def blocks(a: Floats) -> Floats:
    """(3, 5) largest magnitude of each 3 x 3 block; the wheel scale moves nothing."""
    assert (a[:, E_WHEEL_SCALE] == 0.0).all()
    result: Floats = np.abs(a[:, :E_WHEEL_SCALE]).reshape(3, 3, 5, 3).max(axis=(1, 3))
    return result


RELATIVE = np.array(
    # position, velocity, attitude, gyro bias, accelerometer bias
    [[0.0, 1e-4, 1e-4, 2e-3, 4e-3], [4e-3, 0.0, 2e-4, 4e-3, 4e-3], [2e-2, 1e-4, 0.0, 4e-3, 1.0]]
)
"""Of the largest entry of a block. Biases: the attitude is that of each step's start (rate dt / 2 = 0.2 %). Position
and velocity columns: the slow terms are of first order in the span, taken at its end, and the radii's change with
latitude (0.3 %) is neglected. Attitude against accelerometer bias is of third order and left out."""
SECOND_ORDER = 2e-6
"""Diagonal blocks, times span^2: the gravity gradient's second-order part, 3.1e-6 / 2 1/s^2, is left out."""
ROUNDING = 2e-9
"""Latitude is known to 7e-10 m in double precision."""


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_transition_equals_differences_of_the_strapdown(seconds: float) -> None:
    phi, found = transitions(seconds, 1.0)
    allowed = RELATIVE * blocks(found) + ROUNDING + SECOND_ORDER * seconds**2 * np.eye(3, 5)
    assert (blocks(phi - found) <= allowed).all(), blocks(phi - found) / allowed
    assert blocks(found)[2, 4] < 1e-6  # what is left out does not matter


def test_transition_holds_for_tiny_errors() -> None:
    """1e-7 rad, 1e-5 m/s, 1e-9 rad/s: no branch and no cancellation near zero (positions are too coarse for this)."""
    phi, found = transitions(0.1, 1e-4)
    allowed = RELATIVE * blocks(found) + ROUNDING + SECOND_ORDER * 0.1**2 * np.eye(3, 5)
    assert (blocks(phi - found) <= allowed)[1:].all()


def motion_of(nav: Floats) -> Motion:
    """The motion that a state describes, with the rate that the gyro shows once its bias is gone."""
    one = (np.zeros(1, np.int64), nav[None, LLH], nav[None, VELOCITY], nav[None, QUATERNION])
    return Motion(*one, GYRO[None] - nav[None, GYRO_BIAS], np.zeros((1, 3)))


def rate() -> tuple[float, float, float]:
    x, y, z = GYRO - NAV[GYRO_BIAS]
    return float(x), float(y), float(z)


Residual = Callable[[Floats, Floats], Floats]
"""(true state, H to fill) -> residual (3,) at NAV of what an exact sensor would show in the true state."""


def position(true: Floats, H: Floats) -> Floats:
    llh = motion_of(true).place_of(ARM)[0]
    return np.array(gnss_position(NAV, attitude(NAV), H, triple(llh), ARM))


def velocity(true: Floats, H: Floats) -> Floats:
    vel = motion_of(true).velocity_of(ARM)[0]
    return np.array(gnss_velocity(NAV, attitude(NAV), H, triple(vel), ARM, rate()))


def yaw(true: Floats, H: Floats) -> Floats:
    predicted = yaw_row(attitude(NAV), H, 0)
    return np.array([wrap_kernel(yaw_from_q(true[QUATERNION]) - predicted), 0.0, 0.0])


def rear_axle(true: Floats, H: Floats) -> Floats:
    """Velocity in body axes of a point that does not slip: wheel speed ahead, nothing to the left and up."""
    R = matrix_from_q(true[QUATERNION])
    seen = R.T @ true[VELOCITY] + np.cross(GYRO - true[GYRO_BIAS], ARM)
    return np.asarray(seen - np.array(body_velocity(NAV, attitude(NAV), H, ARM, rate())))


def wheel(true: Floats, H: Floats) -> Floats:
    R = matrix_from_q(true[QUATERNION])
    seen = R.T @ true[VELOCITY] + np.cross(GYRO - true[GYRO_BIAS], ARM)
    speed = float(seen[0] * (1.0 + true[WHEEL_SCALE]))
    return np.array([wheel_speed(NAV, attitude(NAV), H, speed, ARM, rate()), 0.0, 0.0])


def fix_in(frame: MapFrame) -> Residual:
    """A pose fix in a map frame, by the simulator's path into the map and the filter's path back."""

    def residual(true: Floats, H: Floats) -> Floats:
        motion = motion_of(true)
        p_map = map_from_llh(frame, motion.place_of(ARM))[0]
        yaw_map = yaw_from_q(attitude_in_map(motion, frame))[0]
        now = np.zeros(1, np.int64)
        fix = PoseFix(now, now, np.array([[p_map[0], p_map[1], yaw_map]]), np.eye(3)[None])
        llh, east_yaw, tilt, *_ = pose_columns(fix, frame, HONEST)
        r = attitude(NAV)
        length = float(np.hypot(r[0], r[3]))
        heading = (r[0] / length, r[3] / length)
        slope = (float(tilt[0, 0]), float(tilt[0, 1]))
        return np.array(pose_fix(r, H, NAV, triple(llh[0]), float(east_yaw[0]), slope, ARM, heading))

    return residual


def triple(v: Floats) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


UTM = utm_frame(NAV[LLH])
FAR_PLANE = MapFrame("enu", (47.9, 11.2, 500.0))
"""A plane whose datum lies 31 km away: its vertical differs by 0.28 deg."""
SENSORS: dict[str, tuple[Residual, float, float]] = {
    # residual, largest residual of an exact measurement, tolerance of H in the sensor's unit per SCALE
    "gnss position": (position, 1e-6, 1e-6),  # the local plane is flat to 1 m^2 / earth's radius
    "gnss velocity": (velocity, 1e-12, 2e-7),  # the earth's rate times the lever arm's turn is left out
    "gnss yaw": (yaw, 1e-12, 1e-8),
    "rear axle": (rear_axle, 1e-12, 1e-8),  # differences: 22 m/s (1e-3 rad)^3 / 6
    "wheel": (wheel, 1e-12, 2e-4),  # differences: the product of both errors is of second order
    "pose fix in UTM": (fix_in(UTM), 1e-6, 1e-4),  # map metres are metres on the ellipsoid, 560 m below
    "pose fix in a far ENU plane": (fix_in(FAR_PLANE), 4.5e-4, 1e-5),  # yaw: tilt times pitch is left out
}


def differences(residual: Residual, size: float) -> Floats:
    """(3, 16) central differences of a residual against errors of size times SCALE, per SCALE."""
    found, scratch = np.empty((3, ERROR_SIZE)), np.zeros((3, ROW))
    for i, step in enumerate(np.diag(size * SCALE)):
        ahead, behind = residual(plus(NAV, step), scratch), residual(plus(NAV, -step), scratch)
        found[:, i] = (ahead - behind) / (2 * size)
    return found


@pytest.mark.parametrize("name", SENSORS)
def test_measurement_jacobian(name: str) -> None:
    residual, exact, tolerance = SENSORS[name]
    H = np.zeros((3, ROW))
    assert np.abs(residual(NAV, H)).max() <= exact
    assert (H[0, E_WHEEL_SCALE] != 0.0) == (name == "wheel")
    assert (np.abs(H).max(axis=1) > 0.1).sum() == (1 if name in ("gnss yaw", "wheel") else 3)
    for size in (1.0, 1e-4):
        difference = np.abs(H * SCALE - differences(residual, size))
        assert difference.max() <= tolerance + ROUNDING / size, difference


def test_yaw_residual_takes_the_short_way_round() -> None:
    nav = np.concatenate((NAV[:6], q_from_rpy(0.1, -0.05, np.pi - 1e-4)[0], NAV[10:]))
    H = np.zeros((3, ROW))
    predicted = yaw_row(attitude(nav), H, 0)
    assert wrap_kernel(-np.pi + 1e-4 - predicted) == pytest.approx(2e-4, abs=1e-12)
    turned = plus(nav, np.array([0.0] * 8 + [3e-4] + [0.0] * 7))
    assert wrap_kernel(yaw_from_q(turned[QUATERNION]) - predicted) == pytest.approx(3e-4, abs=1e-9)
    still_there = differences_of_yaw(nav)
    assert np.abs(H[0, 6:9] - still_there).max() < 1e-8


def differences_of_yaw(nav: Floats) -> Floats:
    """(3,) change of yaw per rad of attitude error, across +-pi where nav lies there."""
    found = np.empty(3)
    for i in range(3):
        step = np.zeros(ERROR_SIZE)
        step[6 + i] = 5e-4
        ahead, behind = (float(yaw_from_q(plus(nav, sign * step)[QUATERNION])) for sign in (1.0, -1.0))
        found[i] = ((ahead - behind + np.pi) % (2 * np.pi) - np.pi) / 1e-3
    return found


@pytest.mark.parametrize("size", [1e-7, 1e-2, 1.0])
def test_injection_adds_the_error(size: float) -> None:
    """To 1e-9 of the step: what the kernel keeps of the place (radii, latitude) serves inject as well."""
    rng = np.random.default_rng(1)
    core = core_at(NAV, shaken(0.1))
    for _ in range(5):
        dx = np.zeros(ROW)
        dx = size * SCALE * rng.standard_normal(ROW)
        expected = plus(core.nav, dx)
        inject(core.nav, core.earth, dx)
        difference = minus(core.nav, expected) / SCALE
        assert np.abs(difference).max() < 1e-6 * size + ROUNDING


def reset_jacobian(b: Floats) -> Floats:
    """(3, 3) d log(Exp(a) Exp(-b)) / da at a = b by central differences."""
    found, undo = np.empty((3, 3)), Rotation.from_rotvec(-b)
    for i, step in enumerate(np.eye(3) * 1e-5):
        ahead, behind = ((Rotation.from_rotvec(b + sign * step) * undo).as_rotvec() for sign in (1.0, -1.0))
        found[:, i] = (ahead - behind) / 2e-5
    return found


@pytest.mark.parametrize("size", [1e-7, 1e-3, 0.1])
def test_reset_jacobian(size: float) -> None:
    """The kernel's G is of first order: what it leaves out is |b|^2 / 6."""
    b = size * np.array([0.6, -0.5, np.sqrt(1 - 0.61)])
    root = np.random.default_rng(2).standard_normal((15, 15))
    cov = np.zeros((ROW, ROW))
    cov[:15, :15] = root @ root.T
    P = cov.copy()
    reset(P, (0.5 * b[0], 0.5 * b[1], 0.5 * b[2]))
    G = np.eye(ROW)
    G[E_ATTITUDE, E_ATTITUDE] = reset_jacobian(b)
    allowed = (size**2 / 6 + 1e-9) * np.abs(cov).max() * 4
    assert np.abs(P - G @ cov @ G.T).max() < allowed
    if size > 1e-3:  # leaving the reset out would show
        assert np.abs(cov - G @ cov @ G.T).max() > 3 * allowed
