"""Predicted localizability: how well each pose would be known from the elements around it, before anybody drives.

The Fisher information of small observations (``sensors.maps.evidence``) about the pose, whose inverse bounds the
covariance of any unbiased estimate (Censi, On achievable accuracy for range-finder localization, ICRA 2007); with
observations along normals it is also what registration attains (Bonnabel, Barczyk and Goulette, On the covariance of
ICP-based scan-matching techniques, ACC 2016). An observation at r = (x, y), along n, in body axes, has the Jacobian
j = (n_x, n_y, x n_y - y n_x) with respect to the pose's offset (longitudinal m, lateral m, yaw rad).

Neighbours err together (EgoVM divides its score by the number of elements: twice as many do not make it twice as sure):
all evidence of one class within a cell shares a displacement b ~ N(0, shared_m^2 I). It is a nuisance parameter and is
eliminated cell by cell: with A = sum w j j^T, B = sum w j n^T, C = sum w n n^T a cell gives

    A - B (C + I / shared_m^2)^-1 B^T,

so that its information about position never exceeds 1 / shared_m^2, however often an element is repeated.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel
from sensors.maps.evidence import CLASSES, Evidence, Model, evidence
from sensors.maps.map_file import MapFile
from sensors.maps.vector_map import Elements, Floats, Surfels

AXES = ("lon", "lat", "yaw")
CHUNK_M = 500.0
"""Poses within a square of this side are judged with one look at the map, m."""
BUCKET_M = 20.0
"""Evidence is looked up in squares of this side, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Localizability:
    """Of N poses. information: (N, 3, 3) of (longitudinal m, lateral m, yaw rad), body axes, from the map alone;
    sigma: (N, 3) m, m, rad, each axis's own with the others unknown, within what is searched;
    weakest: (N,) rad, the direction in which the position is known worst, from the heading, -pi/2..pi/2.
    """

    information: Floats
    sigma: Floats
    weakest: Floats

    def __len__(self) -> int:
        return len(self.sigma)

    def degenerate(self, limits: tuple[float, float, float], share: float) -> NDArray[np.bool_]:
        """(N, 3) axes whose sigma is beyond a share of their limit (m, m, rad)."""
        wrong: NDArray[np.bool_] = self.sigma > share * np.array(limits)
        return wrong


def localizability(
    elements: Elements, surfels: Surfels, xy: Floats, heading: Floats, model: Model | None = None
) -> Localizability:
    """Of poses (N, 2) m and (N,) rad in the frame of a part of a map that reaches as far as they see."""
    model = model or Model()
    return judged(information(evidence(elements, surfels, model), xy, heading, model), model)


def along(opened: MapFile, xy: Floats, heading: Floats, model: Model | None = None) -> Localizability:
    """Of poses (N, 2) m and (N,) rad in the frame of a map file, chunk by chunk, in bounded memory."""
    model = model or Model()
    found = np.empty((len(xy), 3, 3))
    for rows in chunks(xy):
        low, high = xy[rows].min(axis=0), xy[rows].max(axis=0)
        middle = (low + high) / 2.0
        radius = 0.5 * float(np.hypot(*(high - low))) + math.sqrt(2.0) * model.reach_m + 2.0 * model.join_m + 1.0
        part = opened.around(float(middle[0]), float(middle[1]), radius)
        found[rows] = information(evidence(*part, model), xy[rows], heading[rows], model)
    return judged(found, model)


def chunks(xy: Floats) -> Iterator[NDArray[np.intp]]:
    """Rows of (N, 2) places that lie in one square of CHUNK_M, neighbours after each other (Morton order)."""
    if not len(xy):
        return
    square = np.floor(xy / CHUNK_M).astype(np.int64)
    code = _spread(square[:, 0] - square[:, 0].min()) | _spread(square[:, 1] - square[:, 1].min()) << 1
    order = np.argsort(code, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(code[order])) + 1)


def _spread(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Their lowest 16 bits, a zero between each two."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        numbers = (numbers | numbers << shift) & mask
    return numbers


def judged(found: Floats, model: Model) -> Localizability:
    """Sigmas of (N, 3, 3) information. The search adds what a flat score within its range has: variance range^2 / 3."""
    search = np.array([model.search_m, model.search_m, math.radians(model.search_deg)])
    covariance = np.linalg.inv(found + np.diag(3.0 / search**2))
    sigma = np.sqrt(covariance.diagonal(axis1=1, axis2=2))
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return Localizability(found, sigma, 0.5 * np.arctan2(2.0 * xy, xx - yy))


def information(found: Evidence, xy: Floats, heading: Floats, model: Model) -> Floats:
    """(N, 3, 3) information of poses (N, 2) m and (N,) rad from evidence in the same frame."""
    result = np.zeros((len(xy), 3, 3))
    if not len(xy):
        return result
    reach = math.sqrt(2.0) * model.reach_m
    near = ((found.place >= xy.min(axis=0) - reach) & (found.place <= xy.max(axis=0) + reach)).all(axis=1)
    if not near.any():
        return result
    found = Evidence(found.place[near], found.normal[near], found.weight[near], found.group[near])
    origin = np.minimum(found.place.min(axis=0), xy.min(axis=0))
    cell = np.floor((found.place - origin) / BUCKET_M).astype(np.int64)
    wide, high = (cell.max(axis=0) + 1).tolist()
    bucket = cell[:, 1] * wide + cell[:, 0]
    order = np.argsort(bucket, kind="stable")
    first = np.searchsorted(bucket[order], np.arange(wide * high + 1))
    across = 2 * math.floor(model.reach_m / model.cell_m + 0.5) + 1
    sums = np.zeros((CLASSES * across * across, 6))
    _add_up(
        *(np.ascontiguousarray(column[order]) for column in found),
        first,
        wide,
        high,
        np.ascontiguousarray(xy - origin),
        origin,
        np.ascontiguousarray(heading, np.float64),
        model.reach_m,
        model.cell_m,
        across,
        model.shared_m**-2,
        sums,
        np.zeros(len(sums), np.int64),
        np.zeros(len(sums), np.bool_),
        result,
    )
    return result


@kernel()
def _add_up(  # type: ignore[no-untyped-def]
    place, normal, weight, group, first, wide, high, local, origin, heading, reach, cell, across, stiff, sums, touched,
    used, result,
):  # fmt: skip
    """Fill result (N, 3, 3). sums (groups, 6): C (3), d = sum w c n (2), e = sum w c^2, with c = x n_y - y n_x."""
    for pose in range(len(local)):
        cos, sin = math.cos(heading[pose]), math.sin(heading[pose])
        half = reach * (abs(cos) + abs(sin))
        count = 0
        x0, y0 = local[pose, 0], local[pose, 1]
        left = max(math.floor((x0 - half) / BUCKET_M), 0)
        right = min(math.floor((x0 + half) / BUCKET_M), wide - 1)
        low = max(math.floor((y0 - half) / BUCKET_M), 0)
        top = min(math.floor((y0 + half) / BUCKET_M), high - 1)
        for row in range(low, top + 1):
            if left > right:
                break
            for i in range(first[row * wide + left], first[row * wide + right + 1]):
                dx, dy = place[i, 0] - origin[0] - x0, place[i, 1] - origin[1] - y0
                x, y = cos * dx + sin * dy, cos * dy - sin * dx
                if abs(x) > reach or abs(y) > reach:
                    continue
                nx, ny = cos * normal[i, 0] + sin * normal[i, 1], cos * normal[i, 1] - sin * normal[i, 0]
                column = math.floor(x / cell + 0.5) + across // 2
                line = math.floor(y / cell + 0.5) + across // 2
                g = (group[i] * across + line) * across + column
                if not used[g]:
                    used[g] = True
                    touched[count] = g
                    count += 1
                w, c = weight[i], x * ny - y * nx
                sums[g, 0] += w * nx * nx
                sums[g, 1] += w * nx * ny
                sums[g, 2] += w * ny * ny
                sums[g, 3] += w * c * nx
                sums[g, 4] += w * c * ny
                sums[g, 5] += w * c * c
        for k in range(count):
            g = touched[k]
            _eliminate(sums[g], stiff, result[pose])
            used[g] = False
            sums[g, :] = 0.0


@kernel()
def _eliminate(s, stiff, result):  # type: ignore[no-untyped-def]
    """Add a cell's information to result (3, 3), less what its shared displacement takes.

    With K = C + stiff I: C - C K^-1 C = stiff K^-1 C, d - C K^-1 d = stiff K^-1 d, e - d^T K^-1 d.
    """
    a, b, c, d0, d1 = s[0] + stiff, s[1], s[2] + stiff, s[3], s[4]
    scale = 1.0 / (a * c - b * b)
    xx, xy, yy = c * scale, -b * scale, a * scale
    k0, k1 = xx * d0 + xy * d1, xy * d0 + yy * d1
    cross = stiff * 0.5 * (xx * s[1] + xy * s[2] + xy * s[0] + yy * s[1])
    result[0, 0] += stiff * (xx * s[0] + xy * s[1])
    result[0, 1] += cross
    result[1, 0] += cross
    result[1, 1] += stiff * (xy * s[1] + yy * s[2])
    result[0, 2] += stiff * k0
    result[2, 0] += stiff * k0
    result[1, 2] += stiff * k1
    result[2, 1] += stiff * k1
    result[2, 2] += s[5] - d0 * k0 - d1 * k1
