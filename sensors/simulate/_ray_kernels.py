"""Kernels of the simulated LiDAR: rays through a uniform grid of cells in the plane. Arrays in and out, no config.

Ground: bilinear in each cell between heights at its corners. Things are numbered plates first, then posts, then balls.
plates (Q, 12): corner o, unit normal, and the vectors whose product with (point - o) is its share along either side;
posts (C, 5): x, y, foot, top, radius; balls (S, 4): centre, radius;
strips (P, 10): begin x, y, unit direction x, y, length, half width, phase, pitch, painted part of it, reflectivity.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NOTHING, GROUND, FIRST = -1, 0, 1
"""Numbers of what a ray hit; FIRST: of the first thing."""
_EDGE_M = 1e-9
"""A patch of ground also counts so far outside its cell: rounding opens no gaps."""


@kernel()
def bins(boxes: Ints, columns: int, first: Ints, items: Ints) -> None:
    """List in each cell the boxes (N, 4) of cells (least, greatest i, then j) over it. first: (cells + 1,), zeros.

    Asked with no items it only counts, so that first tells how many there are.
    """
    if not len(items):
        for row in range(len(boxes)):
            for i in range(boxes[row, 0], boxes[row, 1] + 1):
                for j in range(boxes[row, 2], boxes[row, 3] + 1):
                    first[i * columns + j + 1] += 1
        for cell in range(len(first) - 1):
            first[cell + 1] += first[cell]
        return
    for row in range(len(boxes) - 1, -1, -1):
        for i in range(boxes[row, 0], boxes[row, 1] + 1):
            for j in range(boxes[row, 2], boxes[row, 3] + 1):
                first[i * columns + j + 1] -= 1
                items[first[i * columns + j + 1]] = row


@kernel(inline="always")
def _on_ground(ground: Floats, i: int, j: int, u: float, v: float, z: float, d: Any, cell: float, last: float) -> float:
    """Distance to a patch from shares u, v of its cell and height z, or inf. d: direction; last: m to its end."""
    a, b, c = ground[i, j], ground[i + 1, j] - ground[i, j], ground[i, j + 1] - ground[i, j]
    twist = ground[i + 1, j + 1] - ground[i, j + 1] - b
    du, dv = d[0] / cell, d[1] / cell
    square = -twist * du * dv
    slope = d[2] - b * du - c * dv - twist * (u * dv + v * du)
    above = z - a - b * u - c * v - twist * u * v
    if above > 0.0 and square <= 0.0 and above + last * (slope + last * square) > 0.0:
        return math.inf
    if square == 0.0:
        only: float = _between(-above / slope if slope != 0.0 else math.inf, last)
        return only
    root = slope * slope - 4.0 * square * above
    if root < 0.0:
        return math.inf
    q = -0.5 * (slope + math.copysign(math.sqrt(root), slope))
    far: float = _between(q / square, last)
    near: float = _between(above / q, last) if q != 0.0 else math.inf
    return min(near, far)


@kernel(inline="always")
def _between(t: float, last: float) -> float:
    return t if -_EDGE_M <= t <= last + _EDGE_M else math.inf


@kernel(inline="always")
def _plate(plate: Any, p: Any, d: Any) -> tuple[float, float]:
    """Distance to a plate, inf where the ray misses it, and the cosine of its incidence."""
    cosine = plate[3] * d[0] + plate[4] * d[1] + plate[5] * d[2]
    x, y, z = p[0] - plate[0], p[1] - plate[1], p[2] - plate[2]
    if cosine == 0.0:
        return math.inf, 0.0
    t = -(plate[3] * x + plate[4] * y + plate[5] * z) / cosine
    if t <= 0.0:
        return math.inf, 0.0
    x, y, z = x + t * d[0], y + t * d[1], z + t * d[2]
    a = plate[6] * x + plate[7] * y + plate[8] * z
    b = plate[9] * x + plate[10] * y + plate[11] * z
    if a < 0.0 or a > 1.0 or b < 0.0 or b > 1.0:
        return math.inf, 0.0
    return t, abs(cosine)


@kernel(inline="always")
def _post(post: Any, p: Any, d: Any) -> tuple[float, float]:
    """The same of an upright cylinder without ends, from outside."""
    x, y, radius = p[0] - post[0], p[1] - post[1], post[4]
    a, half, c = d[0] * d[0] + d[1] * d[1], x * d[0] + y * d[1], x * x + y * y - radius * radius
    root = half * half - a * c
    if a == 0.0 or root < 0.0:
        return math.inf, 0.0
    t = (-half - math.sqrt(root)) / a
    z = p[2] + t * d[2]
    if t <= 0.0 or z < post[2] or z > post[3]:
        return math.inf, 0.0
    return t, math.sqrt(root) / radius


@kernel(inline="always")
def _ball(ball: Any, p: Any, d: Any) -> tuple[float, float]:
    """The same of a sphere."""
    x, y, z, radius = p[0] - ball[0], p[1] - ball[1], p[2] - ball[2], ball[3]
    half = x * d[0] + y * d[1] + z * d[2]
    root = half * half - (x * x + y * y + z * z - radius * radius)
    if root < 0.0:
        return math.inf, 0.0
    t = -half - math.sqrt(root)
    return (t, math.sqrt(root) / radius) if t > 0.0 else (math.inf, 0.0)


@kernel()
def _first_hit(
    p: Any,
    d: Any,
    most: float,
    corner: Any,
    cell: float,
    ground: Floats,
    top: Floats,
    plates: Floats,
    posts: Floats,
    balls: Floats,
    first: Ints,
    items: Ints,
) -> tuple[float, int, float]:
    """Distance, number and cosine of incidence of the first thing on a ray from p along the unit vector d."""
    rows, columns = ground.shape[0] - 1, ground.shape[1] - 1
    x, y = (p[0] - corner[0]) / cell, (p[1] - corner[1]) / cell
    i, j = math.floor(x), math.floor(y)
    step_i, step_j = 1 if d[0] > 0.0 else -1, 1 if d[1] > 0.0 else -1
    across_i = cell / abs(d[0]) if d[0] != 0.0 else math.inf
    across_j = cell / abs(d[1]) if d[1] != 0.0 else math.inf
    next_i = (i + 1 - x if d[0] > 0.0 else x - i) * across_i if d[0] != 0.0 else math.inf
    next_j = (j + 1 - y if d[1] > 0.0 else y - j) * across_j if d[1] != 0.0 else math.inf
    best, what, cosine = most, NOTHING, 0.0
    begin = 0.0
    while begin < best and 0 <= i < rows and 0 <= j < columns:
        end = min(next_i, next_j)
        number = i * columns + j
        if p[2] + d[2] * (begin if d[2] > 0.0 else min(end, best)) <= top[number]:
            for k in range(first[number], first[number + 1]):
                item = items[k]
                if item < len(plates):
                    t, c = _plate(plates[item], p, d)
                elif item < len(plates) + len(posts):
                    t, c = _post(posts[item - len(plates)], p, d)
                else:
                    t, c = _ball(balls[item - len(plates) - len(posts)], p, d)
                if t < best:
                    best, what, cosine = t, FIRST + item, c
            u, v = (p[0] + begin * d[0] - corner[0]) / cell - i, (p[1] + begin * d[1] - corner[1]) / cell - j
            t = begin + _on_ground(ground, i, j, u, v, p[2] + begin * d[2], d, cell, end - begin)
            if t < best:
                best, what = t, GROUND
                east = (ground[i + 1, j] - ground[i, j]) / cell
                north = (ground[i, j + 1] - ground[i, j]) / cell
                cosine = abs(d[2] - east * d[0] - north * d[1]) / math.sqrt(1.0 + east * east + north * north)
        begin = end
        if next_i < next_j:
            i, next_i = i + step_i, next_i + across_i
        else:
            j, next_j = j + step_j, next_j + across_j
    if begin < best:  # the ray left the grid: what it would hit of things that reach beyond is not known of others
        return most, NOTHING, 0.0
    return best, what, cosine


@kernel()
def _paint(
    x: float, y: float, corner: Any, cell: float, columns: int, strips: Floats, first: Ints, items: Ints
) -> float:
    """Reflectivity of the paint at a place on the ground, or -1: none."""
    number = math.floor((x - corner[0]) / cell) * columns + math.floor((y - corner[1]) / cell)
    for k in range(first[number], first[number + 1]):
        strip = strips[items[k]]
        dx, dy = x - strip[0], y - strip[1]
        along, across = dx * strip[2] + dy * strip[3], dy * strip[2] - dx * strip[3]
        inside = 0.0 <= along <= strip[4] and abs(across) <= strip[5]
        if inside and (along + strip[6]) % strip[7] <= strip[8]:
            return float(strip[9])
    return -1.0


@kernel()
def cast(
    origins: Floats,
    rotations: Floats,
    beams: Floats,
    most: float,
    corner: Any,
    cell: float,
    ground: Floats,
    top: Floats,
    plates: Floats,
    posts: Floats,
    balls: Floats,
    first: Ints,
    items: Ints,
    strips: Floats,
    first_strip: Ints,
    strip_items: Ints,
    shine: Floats,
    distance: Floats,
    cosine: Floats,
    reflectivity: Floats,
    what: Ints,
) -> None:
    """Write what the rays (M, K) hit: distance m (inf: nothing within most), cosine of incidence, reflectivity, what.

    Ray (m, k) goes from origins (M, 3) along rotations (M, 3, 3) @ beams (M, K, 3), unit vectors. shine: reflectivity
    of the bare ground, then of every thing.
    """
    columns = ground.shape[1] - 1
    for m in range(len(origins)):
        p, R = (origins[m, 0], origins[m, 1], origins[m, 2]), rotations[m]
        for k in range(beams.shape[1]):
            bx, by, bz = beams[m, k, 0], beams[m, k, 1], beams[m, k, 2]
            d = (
                R[0, 0] * bx + R[0, 1] * by + R[0, 2] * bz,
                R[1, 0] * bx + R[1, 1] * by + R[1, 2] * bz,
                R[2, 0] * bx + R[2, 1] * by + R[2, 2] * bz,
            )
            t, hit, c = _first_hit(p, d, most, corner, cell, ground, top, plates, posts, balls, first, items)
            what[m, k], cosine[m, k] = hit, c
            distance[m, k] = t if hit != NOTHING else math.inf
            bright = shine[hit] if hit != NOTHING else 0.0
            if hit == GROUND:
                painted = _paint(
                    p[0] + t * d[0], p[1] + t * d[1], corner, cell, columns, strips, first_strip, strip_items
                )
                bright = painted if painted >= 0.0 else bright
            reflectivity[m, k] = bright
