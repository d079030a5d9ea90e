"""What a first state inherits of the errors of the measurement that it was taken from.

The state is off by what the measurement was off: with the share of that which lasts (``fusion.blocks``) and a constant
yaw error of pose fixes it is correlated from the start, or the next fixes would seem to confirm it independently.
"""

import math

import numpy as np

from fusion.baselines import Fix
from fusion.events import Parameters
from fusion.state import E_POSITION, Floats


def inherit_gnss(P: Floats, fix: Fix, par: Parameters) -> None:
    """Of a GNSS position: P (n, n) gets its whole covariance and the correlation with the states of what lasts."""
    first, (white, lasts) = par.layout.gnss_error, par.gnss_shares
    if first < 0:
        return
    P[E_POSITION, E_POSITION] += (white + lasts - 1.0) * fix.cov
    share = -math.sqrt(lasts) * np.linalg.cholesky(fix.cov)
    P[E_POSITION, first : first + 3], P[first : first + 3, E_POSITION] = share, share.T


def inherit_pose(P: Floats, fix: Fix, par: Parameters, *, yaw_too: bool) -> None:
    """Of a pose fix: value llh and yaw from east, cov (3, 3) in (east, north, yaw); yaw_too: the yaw is its as well."""
    layout, (white, lasts) = par.layout, par.pose_shares
    yaw_too = yaw_too and fix.cov[2, 2] <= par.pose_limits[2] ** 2
    taken = np.array([0, 1, 8] if yaw_too else [0, 1])
    if yaw_too and layout.pose_yaw >= 0:
        k = layout.pose_yaw
        P[8, 8] += P[k, k]
        P[8, k] = P[k, 8] = -P[k, k]
    if layout.pose_error < 0:
        return
    c, s = math.cos(fix.value[3]), math.sin(fix.value[3])
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    share = (-math.sqrt(lasts) * axes.T @ np.linalg.cholesky(axes @ fix.cov @ axes.T))[: len(taken)]
    P[np.ix_(taken, taken)] += (white + lasts - 1.0) * fix.cov[: len(taken), : len(taken)]
    block = np.arange(layout.pose_error, layout.pose_error + 3)
    P[np.ix_(taken, block)], P[np.ix_(block, taken)] = share, share.T
