"""Short stretches of IMU data fitted to GNSS positions or velocities: the base of clock-offset and mounting estimates.

Over a window of some ten seconds the strapdown solution is linear in what is not known of it (start position and
velocity, attitude, both biases), so each window is one small least-squares problem. No vehicle model enters: the fit
holds for any rigid body whose antenna is near its IMU. Source: Groves 2013, ch. 5 (strapdown) and 14.2 (what of its
error shows in position); windows as in in-motion alignment.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from sensors._kernels import STANDARD_GRAVITY
from sensors.clock import seconds
from sensors.records import Imu
from sensors.rotation import matrix_from_q, multiply

Floats = NDArray[np.float64]
Kind = Literal["position", "velocity"]

ACCEL_BIAS_PRIOR = 0.3
"""Standard deviation of a consumer accelerometer's bias, m/s^2."""
GYRO_BIAS_PRIOR = 0.003
"""Standard deviation of a consumer gyro's bias, rad/s."""
ITERATIONS = 15
"""At most; a window converges in 4 or 5."""
MAX_GAP_S = 0.1
"""A window across a longer pause in the IMU is not fitted."""


@dataclass(frozen=True, slots=True, eq=False)
class Strapdown:
    """The IMU integrated once from its first sample, in the axes s that the body had then.

    t: (N,) s since origin_ns; R_s_body: (N, 3, 3); columns: (N, 48) cumulative integrals, see ``_OFFSETS``.
    """

    origin_ns: int
    t: Floats
    R_s_body: Floats
    columns: Floats


_OFFSETS = {"f1": slice(0, 3), "f2": slice(3, 6), "c1": slice(6, 15), "c2": slice(15, 24)} | {
    "k1": slice(24, 33),
    "k2": slice(33, 42),
    "j0": slice(42, 51),
}
"""First and second integrals of f = R_s_body accel, of c = R_s_body, of k = [f]x j with j = integral of c; j itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One fitted window.

    rows: its GNSS rows; R_enu_s: attitude; vel_enu: (M, 3) fitted velocity at the rows; cost: weighted sum of squares;
    residual: (M, 3) m or m/s; yaw_sigma: of the attitude about the vertical, rad, scaled by how well the window fits.
    """

    rows: NDArray[np.int64]
    R_enu_s: Floats
    vel_enu: Floats
    cost: float
    residual: Floats
    yaw_sigma: float


def strapdown(imu: Imu) -> Strapdown:
    """Integrate the attitude exactly for constant rates and accumulate the integrals that every window needs."""
    origin = int(imu.t_ns[0])
    t = seconds(imu.t_ns, origin)
    R = matrix_from_q(_cumulative_attitude(t, imu.gyro))
    f = np.einsum("nij,nj->ni", R, imu.accel)
    c = R.reshape(-1, 9)
    j = _integral(c, t)
    k = (_skew(f) @ j.reshape(-1, 3, 3)).reshape(-1, 9)
    f1, c1, k1 = _integral(f, t), j, _integral(k, t)
    columns = np.concatenate((f1, _integral(f1, t), c1, _integral(c1, t), k1, _integral(k1, t), j), axis=1)
    return Strapdown(origin, t, R, columns)


def moving_windows(
    t_ns: NDArray[np.int64], speed: Floats, length_s: float, min_speed_change: float, step_s: float | None = None
) -> list[NDArray[np.int64]]:
    """Rows of windows of one length in which the speed (N,) changes, one every step_s (default: end to end).

    A window with less than 80 % of the rows of the fullest one (lost fixes) is left out.
    """
    length, step = int(length_s * 1e9), int((step_s or length_s) * 1e9)
    starts = np.arange(t_ns[0], t_ns[-1] - length, step)
    bounds = np.searchsorted(t_ns, np.stack((starts, starts + length), axis=1))
    if not len(bounds):
        return []
    full = 0.8 * np.diff(bounds, axis=1).max()
    groups = [np.arange(first, last) for first, last in bounds if last - first >= full]
    return [rows for rows in groups if np.ptp(speed[rows]) >= min_speed_change]


def fit_window(
    path: Strapdown,
    t_ns: NDArray[np.int64],
    values: Floats,
    sigma: Floats,
    rows: NDArray[np.int64],
    delay_s: float,
    kind: Kind,
) -> Window | None:
    """Fit one window of values (N, 3) ENU m or m/s, true delay_s before their stamps; None where the IMU has a gap."""
    t = seconds(t_ns[rows], path.origin_ns) - delay_s
    inside = path.t[(path.t >= t[0] - MAX_GAP_S) & (path.t <= t[-1] + MAX_GAP_S)]
    if len(inside) < 2 or inside[0] > t[0] or inside[-1] < t[-1] or np.diff(inside).max() > MAX_GAP_S:
        return None
    order = "2" if kind == "position" else "1"
    at = _sample(path, t)
    elapsed = t - t[0]
    drop = np.stack((np.ones_like(elapsed), elapsed) if kind == "position" else (np.ones_like(elapsed),), axis=1)
    Q, _ = np.linalg.qr(drop)
    gravity = np.zeros((len(t), 3))
    # good to 0.3 %: the accelerometer bias of the fit takes the rest
    gravity[:, 2] = STANDARD_GRAVITY * (elapsed**2 / 2 if kind == "position" else elapsed)
    y = _detrend(Q, values[rows] + gravity)
    f = _detrend(Q, at[:, _OFFSETS["f" + order]])
    c = _detrend(Q, at[:, _OFFSETS["c" + order]]).reshape(-1, 3, 3)
    J0 = at[0, _OFFSETS["j0"]].reshape(3, 3)
    k = _detrend(Q, at[:, _OFFSETS["k" + order]]).reshape(-1, 3, 3) - _skew(f) @ J0
    problem = _Problem(y, f, c, k, 1.0 / sigma[rows])
    R, bias, attitude_cov = _solve(problem)
    residual, cost = problem.residual(R, bias)
    velocity = _velocity(at, values[rows], gravity, elapsed, R, bias, J0, kind)
    spread = cost / max(residual.size - 15, 1)
    return Window(rows, R, velocity, cost, residual, float(np.sqrt(attitude_cov[2, 2] * spread)))


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """y = R (f - c ba + k bg) with the free start removed: y, f, weight (M, 3); c, k (M, 3, 3)."""

    y: Floats
    f: Floats
    c: Floats
    k: Floats
    weight: Floats

    def columns(self, R: Floats) -> Floats:
        """(M, 3, 6) derivatives by accelerometer and gyro bias."""
        return np.concatenate((-R @ self.c, R @ self.k), axis=2)

    def residual(self, R: Floats, bias: Floats) -> tuple[Floats, float]:
        residual = self.y - self.f @ R.T - self.columns(R) @ bias
        return residual, float(np.sum((residual * self.weight) ** 2) + np.sum((_SHARP * bias) ** 2))


_SHARP = 1.0 / np.array([ACCEL_BIAS_PRIOR] * 3 + [GYRO_BIAS_PRIOR] * 3)


def _solve(problem: _Problem) -> tuple[Floats, Floats, Floats]:
    """R_enu_s, (6,) biases and (3, 3) attitude covariance; four starts in yaw, as a calm window hardly shows it."""
    level = Rotation.align_vectors(problem.y, problem.f)[0]
    turns = Rotation.from_euler("z", np.array([[0.0], [0.5], [1.0], [1.5]]) * np.pi)
    starts = [_descend(problem, start.as_matrix(), np.zeros(6), 4) for start in turns * level]
    best = min(starts, key=lambda found: problem.residual(found[0], found[1])[1])
    return _descend(problem, best[0], best[1], ITERATIONS)


def _descend(problem: _Problem, R: Floats, bias: Floats, iterations: int) -> tuple[Floats, Floats, Floats]:
    """Levenberg-Marquardt over attitude (left error, ENU) and biases with their priors."""
    residual, cost = problem.residual(R, bias)
    damping = 1e-3
    normal = np.eye(9)
    for _ in range(iterations):
        columns = np.concatenate((-_skew(problem.f @ R.T), problem.columns(R)), axis=2) * problem.weight[:, :, None]
        H = columns.reshape(-1, 9)
        normal = H.T @ H
        normal[3:, 3:] += np.diag(_SHARP**2)
        gradient = H.T @ (residual * problem.weight).ravel()
        gradient[3:] -= _SHARP**2 * bias
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        R_next, bias_next = Rotation.from_rotvec(step[:3]).as_matrix() @ R, bias + step[3:]
        residual_next, cost_next = problem.residual(R_next, bias_next)
        if cost_next >= cost:
            damping *= 10
            continue
        converged = cost - cost_next < 1e-6 * cost
        R, bias, residual, cost, damping = R_next, bias_next, residual_next, cost_next, damping / 10
        if converged:
            break
    cov: Floats = np.linalg.pinv(normal)[:3, :3].astype(np.float64)
    return R, bias, cov


def _velocity(
    at: Floats, values: Floats, gravity: Floats, elapsed: Floats, R: Floats, bias: Floats, J0: Floats, kind: Kind
) -> Floats:
    """(M, 3) velocity of the fitted path at the rows: inertial part plus the start velocity that fits best."""
    integral: dict[str, Floats] = {}
    for order in ("1", "2"):
        f, c, k = (at[:, _OFFSETS[name + order]] for name in "fck")
        k = k.reshape(-1, 3, 3) - _skew(f) @ J0
        integral[order] = (f - c.reshape(-1, 3, 3) @ bias[:3] + k @ bias[3:]) @ R.T
    up = np.array([0.0, 0.0, STANDARD_GRAVITY])
    rate: Floats = integral["1"] - elapsed[:, None] * up
    if kind == "velocity":
        start: Floats = np.mean(values - rate, axis=0)
        return np.add(rate, start, dtype=np.float64)
    rest = values + gravity - integral["2"]
    start = np.linalg.lstsq(np.stack((np.ones_like(elapsed), elapsed), axis=1), rest, rcond=None)[0][1]
    return np.add(rate, start, dtype=np.float64)


def _sample(path: Strapdown, t: Floats) -> Floats:
    """(M, 51) cumulative integrals at t, linear between IMU samples."""
    left = np.clip(np.searchsorted(path.t, t, side="right") - 1, 0, len(path.t) - 2)
    weight = ((t - path.t[left]) / (path.t[left + 1] - path.t[left]))[:, None]
    result: Floats = (1 - weight) * path.columns[left] + weight * path.columns[left + 1]
    return result


def _cumulative_attitude(t: Floats, gyro: Floats) -> Floats:
    """(N, 4) xyzw attitude from the first sample on; products by doubling, log2(N) batch steps."""
    turn = (gyro[1:] + gyro[:-1]) / 2 * np.diff(t)[:, None]
    q = np.concatenate(([[0.0, 0.0, 0.0, 1.0]], Rotation.from_rotvec(turn).as_quat()))
    step = 1
    while step < len(q):
        q = np.concatenate((q[:step], multiply(q[:-step], q[step:])))
        step *= 2
    result: Floats = q / np.linalg.norm(q, axis=1, keepdims=True)
    return result


def _integral(columns: Floats, t: Floats) -> Floats:
    result: Floats = cumulative_trapezoid(columns, t, axis=0, initial=0)
    return result


def _detrend(Q: Floats, columns: Floats) -> Floats:
    return columns - Q @ (Q.T @ columns)


def _skew(v: Floats) -> Floats:
    """(N, 3, 3) matrices with _skew(v) @ u = v x u."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
