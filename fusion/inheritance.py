"""What a first state inherits of the errors of the measurement that it was taken from.

The state is off by what the measurement was off: with the share of that which lasts (``fusion.blocks``) and a constant
yaw error of pose fixes, and with lever arm and delay where these are estimated, it is correlated from the start, or the
next fixes would seem to confirm it independently.
"""

import math

import numpy as np

from fusion.baselines import Fix
from fusion.events import Parameters
from fusion.state import E_POSITION, E_VELOCITY, QUATERNION, VELOCITY, Floats
from sensors.rotation import matrix_from_q

UNKNOWN_ACCELERATION = 1.5
"""By so much that of the first state may differ from its mean before, each axis, m/s^2."""


def inherit_gnss(P: Floats, fix: Fix, nav: Floats, rate: Floats, acceleration: Floats, par: Parameters) -> None:
    """Of a GNSS position: P (n, n) gets its whole covariance and the correlation with the states of what lasts, of the
    lever arm and of the delay. nav (17,): the first state; rate (3,): body, rad/s; acceleration (3,): ENU, m/s^2."""
    first, (white, lasts) = par.layout.gnss_error, par.gnss_shares
    R = matrix_from_q(nav[QUATERNION])
    _carry(P, slice(0, 6), par.layout.gnss_arm, -np.vstack((R, R @ np.cross(rate, np.eye(3)).T)))
    _carry(P, slice(0, 6), par.layout.gnss_delay, np.concatenate((nav[VELOCITY], acceleration))[:, None])
    if par.layout.gnss_delay >= 0:
        P[E_VELOCITY, E_VELOCITY] += (
            P[par.layout.gnss_delay, par.layout.gnss_delay] * UNKNOWN_ACCELERATION**2 * np.eye(3)
        )
    if first < 0:
        return
    P[E_POSITION, E_POSITION] += (white + lasts - 1.0) * fix.cov
    share = -math.sqrt(lasts) * np.linalg.cholesky(fix.cov)
    P[E_POSITION, first : first + 3], P[first : first + 3, E_POSITION] = share, share.T


def inherit_pose(P: Floats, fix: Fix, nav: Floats, par: Parameters, *, yaw_too: bool) -> None:
    """Of a pose fix: value llh and yaw from east, cov (3, 3) in (east, north, yaw); yaw_too: the yaw is its as well.
    nav (17,): the first state."""
    layout, (white, lasts) = par.layout, par.pose_shares
    yaw_too = yaw_too and fix.cov[2, 2] <= par.pose_limits[2] ** 2
    taken = np.array([0, 1, 8] if yaw_too else [0, 1])
    _carry(P, slice(2, 3), layout.gnss_arm, -matrix_from_q(nav[QUATERNION])[2:])  # the height is that of the antenna
    _carry(P, slice(0, 2), layout.pose_delay, nav[VELOCITY][:2, None])
    if yaw_too:
        _carry(P, slice(8, 9), layout.pose_yaw, -np.eye(1))
    if layout.pose_error < 0:
        return
    c, s = math.cos(fix.value[3]), math.sin(fix.value[3])
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    share = (-math.sqrt(lasts) * axes.T @ np.linalg.cholesky(axes @ fix.cov @ axes.T))[: len(taken)]
    P[np.ix_(taken, taken)] += (white + lasts - 1.0) * fix.cov[: len(taken), : len(taken)]
    block = np.arange(layout.pose_error, layout.pose_error + 3)
    P[np.ix_(taken, block)], P[np.ix_(block, taken)] = share, share.T


def _carry(P: Floats, rows: slice, first: int, G: Floats) -> None:
    """Errors G x (R, K) of the rows' states, x the K states at first, which have their priors on P's diagonal."""
    if first < 0:
        return
    block = slice(first, first + G.shape[1])
    share = G @ P[block, block]
    P[rows, rows] += share @ G.T
    P[rows, block] += share
    P[block, rows] += share.T
