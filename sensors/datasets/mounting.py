"""How an IMU sits in its vehicle: up from the axis of the turns, forward from the velocity, rear axle from the side
slip.

The non-holonomic constraint needs the axis along which the rear axle moves to a fraction of a degree: at 10 m/s one
degree is 0.17 m/s of false side slip. A vehicle turns about its own vertical, which the gyro shows without any
accelerometer bias (0.1 m/s^2 of bias would tilt a levelled axis by 0.6 deg). Heading and velocity come from short
strapdown fits (``inertial_fit``), which do not assume the constraint, so the estimate does not confirm itself.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import seconds
from sensors.datasets.inertial_fit import Strapdown, Window
from sensors.errors import EgolocError

Floats = NDArray[np.float64]

MIN_SPEED = 4.0
"""Below this the direction of the velocity is too noisy, m/s."""
MAX_YAW_SIGMA = np.radians(5.0)
"""A window whose heading is less certain is left out."""
YAW_FLOOR = np.radians(0.5)
"""What an excellent window's heading is worth: side slip and road bank remain."""
TURNING = 0.1
"""Turns are rates above this, rad/s: far above a consumer gyro's bias."""
SMOOTH_S = 0.5
"""Rates are averaged over this, s, which calms the vibration of an idling engine."""


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """R_body_imu: (3, 3), body FLU; sigma_deg: yaw and pitch of the forward axis, yaw from the scatter of the windows,
    pitch from that of the turns; ahead_m, ahead_sigma_m: how far the IMU lies ahead of the rear axle;
    lateral: weighted rms velocity across the forward axis that remains, m/s; windows: how many were used."""

    R_body_imu: Floats
    sigma_deg: tuple[float, float]
    ahead_m: float
    ahead_sigma_m: float
    lateral: float
    windows: int


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Rows of all windows in IMU axes: velocity v (K, 3) m/s, turn rate about up (K,) rad/s; weight, window: (K,)."""

    v: Floats
    turn: Floats
    weight: Floats
    window: NDArray[np.int64]


def estimate_mounting(
    path: Strapdown, gyro: Floats, t_ns: NDArray[np.int64], delay_s: float, fits: list[Window]
) -> Mounting:
    """Mounting from fitted windows of a drive; gyro: (N, 3) rad/s in the IMU's own axes, of the path's samples.

    Each window is left out once (jackknife) for the sigmas. Raises EgolocError with fewer than 4 windows faster than
    MIN_SPEED whose heading is known.
    """
    if not fits:
        raise EgolocError("mounting: no window of IMU and GNSS in motion")
    up, pitch_sigma = turning_axis(path, gyro, t_ns, fits)
    motion = _motion(path, gyro @ up, t_ns, delay_s, fits)
    names = np.unique(motion.window)
    if len(names) < 4:
        raise EgolocError(f"mounting: {len(names)} windows faster than {MIN_SPEED:g} m/s, at least 4 are needed")
    R, ahead = _solve(motion, up)
    others = [_solve(_subset(motion, motion.window != name), up) for name in names]
    scale = np.sqrt((len(names) - 1) / len(names))
    yaw = np.array([(R @ other[0][0])[1] for other in others])
    lever = np.array([other[1] for other in others])
    sideways = motion.v @ R[1] - ahead * motion.turn
    return Mounting(
        R,
        (float(scale * np.degrees(np.linalg.norm(yaw - yaw.mean()))), pitch_sigma),
        ahead,
        float(scale * np.linalg.norm(lever - lever.mean())),
        float(np.sqrt(motion.weight @ sideways**2 / motion.weight.sum())),
        len(names),
    )


def turning_axis(path: Strapdown, gyro: Floats, t_ns: NDArray[np.int64], fits: list[Window]) -> tuple[Floats, float]:
    """Axis of the turns over the time that the fits span: (3,) unit vector up in IMU axes, and its uncertainty, deg."""
    first = (t_ns[fits[0].rows[0]] - path.origin_ns) * 1e-9
    last = (t_ns[fits[-1].rows[-1]] - path.origin_ns) * 1e-9
    t = np.arange(max(first, path.t[0] + SMOOTH_S), min(last, path.t[-1] - SMOOTH_S), SMOOTH_S)
    rate = _mean_rate(path, gyro, t)
    rate = rate - np.median(rate, axis=0)
    turns = rate[np.linalg.norm(rate, axis=1) > TURNING]
    if len(turns) < 20:
        raise EgolocError(f"mounting: {len(turns) * SMOOTH_S:g} s of turns, at least 10 s are needed")
    values, vectors = np.linalg.eigh(turns.T @ turns)
    axis: Floats = vectors[:, -1]
    starts = np.searchsorted(path.t, (t_ns[[fit.rows[0] for fit in fits]] - path.origin_ns) * 1e-9)
    gravity = np.einsum("nji,nj->i", path.R_s_body[starts], np.stack([fit.R_enu_s[2] for fit in fits]))
    sigma = float(np.degrees(np.sqrt(values[:2].mean() / values[2] / max(len(turns) / 10, 1))))
    return axis * np.sign(axis @ gravity), sigma


def _solve(motion: _Motion, up: Floats) -> tuple[Floats, float]:
    """Alternate between the forward axis (direction of the rear axle's velocity, across up) and the lever ahead of
    it."""
    ahead = 0.0
    R = np.eye(3)
    for _ in range(5):
        axle = motion.v - ahead * motion.turn[:, None] * R[1]
        forward = axle.T @ (motion.weight * np.linalg.norm(axle, axis=1))
        left = np.cross(up, forward)
        left /= np.linalg.norm(left)
        R = np.stack((np.cross(left, up), left, up))
        ahead = float(motion.turn * motion.weight @ (motion.v @ left) / (motion.turn * motion.weight @ motion.turn))
    return R, ahead


def _motion(path: Strapdown, turn: Floats, t_ns: NDArray[np.int64], delay_s: float, fits: list[Window]) -> _Motion:
    """What each window with a known heading says in IMU axes, at its rows faster than MIN_SPEED."""
    parts = []
    for number, fit in enumerate(fit for fit in fits if fit.yaw_sigma < MAX_YAW_SIGMA):
        t = seconds(t_ns[fit.rows], path.origin_ns) - delay_s
        R_imu_enu = path.R_s_body[np.searchsorted(path.t, t)].transpose(0, 2, 1) @ fit.R_enu_s.T
        v = np.einsum("nij,nj->ni", R_imu_enu, fit.vel_enu)
        fast = np.linalg.norm(v, axis=1) > MIN_SPEED
        weight = np.full(len(v), 1.0 / (fit.yaw_sigma**2 + YAW_FLOOR**2))
        rate = _mean_rate(path, turn[:, None], t)[:, 0]
        parts.append(_Motion(v[fast], rate[fast], weight[fast], np.full(int(fast.sum()), number)))
    if not parts:
        raise EgolocError("mounting: no window shows the heading to 5 deg")
    return _Motion(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("v", "turn", "weight", "window")))


def _mean_rate(path: Strapdown, rate: Floats, t: Floats) -> Floats:
    """(M, C) mean of the rates (N, C) over SMOOTH_S around t."""
    steps = (rate[1:] + rate[:-1]) / 2 * np.diff(path.t)[:, None]
    turned = np.concatenate((np.zeros((1, rate.shape[1])), np.cumsum(steps, axis=0)))
    half = SMOOTH_S / 2
    spans = [np.interp(t + half, path.t, c) - np.interp(t - half, path.t, c) for c in turned.T]
    return np.stack(spans, axis=1) / SMOOTH_S


def _subset(motion: _Motion, keep: NDArray[np.bool_]) -> _Motion:
    return _Motion(motion.v[keep], motion.turn[keep], motion.weight[keep], motion.window[keep])
