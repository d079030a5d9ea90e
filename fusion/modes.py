"""Two modes of a pose fix's posterior: how far they spread it, and whether that is what hides a direction.

The truth lies at one of two places. As a covariance about the fix that is one direction, from mode to mode: with it in
R the covariance gate drops the direction in which they differ, and keeps the axes on which they agree.
"""

import numpy as np

from fusion._linalg import Vector
from fusion.gating import diagonalize, observed_directions
from fusion.result import Reason
from fusion.state import Core, Floats
from sensors.kernel import kernel
from sensors.records import PoseFix
from sensors.rotation import wrap

_ACCEPTED = int(Reason.ACCEPTED)
_PARTLY = int(Reason.PARTLY_ACCEPTED)
_COVARIANCE = int(Reason.COVARIANCE)
_MODES_AGREE = int(Reason.MODES_AGREE)
_MULTI_MODAL = int(Reason.MULTI_MODAL)


def spread_of(fixes: PoseFix) -> Floats:
    """(N, 3) m, m, rad in map axes: s with s s' the second moment of two modes about the fix, 0 where there is one.

    With d from the first mode to the second, masses w and 1 - w of them both, and the fix at a share t of the way, that
    is (w t^2 + (1 - w) (1 - t)^2) d d': w (1 - w) d d' for a fix at the mean, (1 - w) d d' for one at the first mode.
    """
    spread = np.zeros((len(fixes), 3))
    two = np.flatnonzero(fixes.weights[:, 1] > 0.0)
    if not len(two):
        return spread
    first, second = fixes.modes[two, 0], fixes.modes[two, 1]
    apart, gone = second - first, fixes.pose[two] - first
    apart[:, 2], gone[:, 2] = wrap(apart[:, 2]), wrap(gone[:, 2])
    scale = np.array([1.0, 1.0, 10.0])  # m for a rad: which mode the fix is nearer to, not how far
    length = np.sum((apart * scale) ** 2, axis=1)
    share = np.sum(apart * gone * scale**2, axis=1) / np.where(length > 0.0, length, 1.0)
    t, w = np.clip(share, 0.0, 1.0), fixes.weights[two, 0] / fixes.weights[two].sum(axis=1)
    spread[two] = np.sqrt(w * t**2 + (1.0 - w) * (1.0 - t) ** 2)[:, None] * apart
    return spread


@kernel()
def observed_without(R: Floats, spread: Vector, limits: Vector, eigen: Floats) -> int:
    """Directions that would be observed if the fix had one mode only: eigenvalues of at most 1 of D^-1 (R - s s') D^-1.

    eigen (2, 3, 3): scratch.
    """
    for i in range(3):
        for j in range(3):
            eigen[0, i, j] = (R[i, j] - spread[i] * spread[j]) / (limits[i] * limits[j])
    diagonalize(eigen)
    kept = 0
    for k in range(3):
        if eigen[0, k, k] <= 1.0:
            kept += 1
    return kept


@kernel()
def observe(core: Core, limits: Vector, partial: bool, spread: Vector) -> tuple[int, int]:
    """Covariance gate of the pose fix in core.residual, H and R (along, left, yaw), reduced to what it observes.

    partial: use the observed directions where others are not; spread: of two modes, which is in R. Returns how many
    directions are left, and the Reason to record where they pass the other gates, or why none is left.
    """
    R = core.R
    trace = R[0, 0] / limits[0] ** 2 + R[1, 1] / limits[1] ** 2 + R[2, 2] / limits[2] ** 2
    if trace <= 1.0:  # then every eigenvalue is
        return 3, _ACCEPTED
    alone = 0  # directions that one mode would leave
    if spread[0] != 0.0 or spread[1] != 0.0 or spread[2] != 0.0:
        alone = observed_without(R, spread, limits, core.eigen)
    kept = observed_directions(core.H, R, core.residual, limits, core.eigen, core.W)
    if kept == 3:
        return 3, _ACCEPTED
    if kept == 0 or not partial:
        return 0, _MULTI_MODAL if kept < alone else _COVARIANCE
    return kept, _MODES_AGREE if kept < alone else _PARTLY
