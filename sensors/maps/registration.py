"""Registration of point clouds by small_gicp: where a scan lies against another or in a cloud, and how surely."""

from collections import OrderedDict
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Positive
from sensors.maps.voxels import Voxels

Floats = NDArray[np.float64]

NEIGHBOURS = 10
"""Of a point, for the plane around it."""
ITERATIONS = 30
STEP_RAD, STEP_M = 1e-5, 1e-4
"""A smaller step ends a registration."""
FLOOR: Floats = np.array([*np.radians((0.1, 0.1, 0.01)), 0.006, 0.006, 0.01])
"""Standard deviation of what no residual shows, (6,) rad, m: beams that graze, uneven sampling. The rings that a LiDAR
draws on the ground go with it: a scan leans, and lifts, towards the rings of the one a few metres before."""
UNKNOWN: Floats = 100.0 * np.eye(6)
"""Covariance of what is refused."""
USUAL_COST = 0.25
"""Squared distance of planes, in small_gicp's unit, where they fit; more of it inflates the covariance."""
FEIGNED = 0.003
"""Of all information, what normals with errors of 3 deg seem to give in a direction that they do not tell."""


class RegistrationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How scans are registered, and when one is believed."""

    voxel_m: Positive = 0.4
    """Scans are thinned to a point in a cube of this side, m."""
    coarse_m: Positive = 2.0
    """Farthest pair of points at first, m: the basin of convergence."""
    fine_m: Positive = 0.8
    """Farthest pair of points in the end, m."""
    min_inliers: Positive = 0.4
    """Least part of the scan's points that find a partner."""
    min_points: int = 200
    """Least points of a thinned scan."""


class Match(NamedTuple):
    """Source in target. T: (4, 4); cov: (6, 6) of rotation rad, then translation m, in the source's axes, T Exp(.).

    inliers: part of the source's points that found a partner; rms_m: their distance from the partner's plane;
    refused: why not to believe it, "" where nothing speaks against it.
    """

    T: Floats
    cov: Floats
    inliers: float
    rms_m: float
    refused: str = ""


class Scan(NamedTuple):
    """A cloud ready to be registered: small_gicp's points with the planes around them, and their tree."""

    points: Any
    tree: Any

    def __len__(self) -> int:
        return int(self.points.size())


def thinned(xyz: Floats, voxel_m: float) -> Floats:
    """(M, 3) a point for each cube that holds any: the mean."""
    voxels = Voxels(voxel_m)
    voxels.add(xyz)
    return voxels.means()


def scan_of(xyz: Floats) -> Scan:
    """Prepare thinned points (N, 3)."""
    import small_gicp

    points = small_gicp.PointCloud(np.ascontiguousarray(xyz, np.float64))
    tree = small_gicp.KdTree(points)
    small_gicp.estimate_covariances(points, tree, NEIGHBOURS)
    return Scan(points, tree)


class Scans:
    """Thinned clouds of many frames, a few of them prepared; float32, so that a drive of an hour fits into memory."""

    def __init__(self, most: int = 48) -> None:
        """most: prepared scans that are kept, about 1.5 MB each."""
        self._clouds: list[NDArray[np.float32]] = []
        self._ready: OrderedDict[int, Scan] = OrderedDict()
        self._most = most

    def __len__(self) -> int:
        return len(self._clouds)

    def add(self, xyz: Floats) -> None:
        """Keep a thinned cloud (N, 3), in the body's axes."""
        self._clouds.append(xyz.astype(np.float32))

    def __getitem__(self, number: int) -> Scan:
        scan = self._ready.pop(number, None) or scan_of(self._clouds[number].astype(np.float64))
        self._ready[number] = scan
        if len(self._ready) > self._most:
            self._ready.popitem(last=False)
        return scan


def register(target: Scan, source: Scan, guess: Floats, config: RegistrationConfig, *, sure: bool = False) -> Match:
    """Where the source lies in the target, from a guess (4, 4). sure: the guess is good to fine_m.

    Generalized ICP. The covariance is that of its normal equations, more where planes fit badly, and FLOOR.
    """
    if min(len(target), len(source)) < config.min_points:
        return Match(guess, UNKNOWN, 0.0, np.nan, f"fewer than {config.min_points} points")
    T, found = guess, None
    for distance in (config.fine_m,) if sure else (config.coarse_m, config.fine_m):
        found = _align(target, source, T, distance)
        T = found.T_target_source
    assert found is not None
    inliers = found.num_inliers / len(source)
    cost = 2.0 * found.error / max(found.num_inliers, 1)
    refused = ""
    if not found.converged or not np.isfinite(T).all():
        refused = "did not converge"
    elif inliers < config.min_inliers:
        refused = f"less than {100 * config.min_inliers:.0f} % of the points found a partner"
    cov = UNKNOWN if refused else _covariance(found.H, cost)
    return Match(T, cov, inliers, float(np.sqrt(cost * PLANE_M2)), refused)


PLANE_M2 = 2e-3
"""Variance of a pair of planes across themselves, m^2: small_gicp sets each one's to 1e-3."""


def _align(target: Scan, source: Scan, guess: Floats, distance: float) -> Any:
    import small_gicp

    return small_gicp.align(
        target.points,
        source.points,
        target.tree,
        init_T_target_source=guess,
        registration_type="GICP",
        max_correspondence_distance=distance,
        num_threads=1,  # with more of them sums come in another order every time
        max_iterations=ITERATIONS,
        rotation_epsilon=STEP_RAD,
        translation_epsilon=STEP_M,
    )


def _covariance(H: Floats, cost: float) -> Floats:
    """(6, 6) of normal equations H, rotation first; along what nothing holds 10 m.

    Planes estimated from noisy points err by some degrees, which looks like knowledge along a corridor: as much as
    they would feign is taken off in every direction.
    """
    reach = np.sqrt(np.trace(H[:3, :3]) / np.trace(H[3:, 3:]))
    scale = np.repeat((1.0 / reach, 1.0), 3)
    values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    held = np.maximum(values - FEIGNED * np.trace(H[3:, 3:]), 1e-2)
    root = scale[:, None] * vectors / np.sqrt(held)
    cov: Floats = root @ root.T * max(1.0, cost / USUAL_COST) + np.diag(FLOOR**2)
    return cov


def sampled(p: Floats, normal: Floats, spacing_m: float) -> Floats:
    """(25 K, 3) points on discs of surfels (K, 3): squares of 5 x 5 points, so that each tells its plane.

    spacing_m: between them.
    """
    aside = np.where(np.abs(normal[:, 2:]) < 0.7, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    first = np.cross(normal, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    steps = spacing_m / 2.0 * np.arange(-2.0, 3.0)
    u, v = (grid.ravel()[None, :, None] for grid in np.meshgrid(steps, steps))
    points: Floats = p[:, None, :] + u * first[:, None, :] + v * second[:, None, :]
    return points.reshape(-1, 3)
