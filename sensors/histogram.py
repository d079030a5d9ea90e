"""What a fix from a histogram over several levels states of itself: its covariance, where any level may be flat."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

FLAT_SHARE = 0.5
"""A direction with more than this share of a flat window's variance is not observed at that level."""


def stated_covariance(levels: ArrayLike, windows: ArrayLike, share: float = FLAT_SHARE) -> Floats:
    """(N, 3, 3) covariance of a fix from those of its levels (N, L, 3, 3), coarse to fine, in (m, m, rad).

    windows: (L, 3) standard deviations of a flat histogram at each level, along the same axes; share: of a flat
    window's variance, above which a level counts as flat.
    It is the finest level's, and along directions in which a coarser level is flat that one's as well: a finer window
    then lies where the prior put it, and a peak in it says nothing. One matrix tells a filter, and every other reader
    of the message, all that it needs: a direction that is flat at any level is dropped, whatever the finest one saw.
    """
    covs, scales = np.asarray(levels, np.float64), np.asarray(windows, np.float64)
    stated: Floats = covs[:, -1].copy()
    for cov, scale in zip(covs.transpose(1, 0, 2, 3)[:-1], scales[:-1], strict=True):
        values, axes = np.linalg.eigh(cov / np.outer(scale, scale))
        flat = np.where(values > share, values, 0.0)
        stated += np.einsum("nik,nk,njk->nij", axes, flat, axes) * np.outer(scale, scale)
    return stated
