"""Districts spread over the plane and joined by highways: curved, long, and crossing the streets on another level."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rng = np.random.Generator

BETWEEN_M = 300.0
"""Least distance between districts, m."""
SEGMENT_M = 1500.0
"""Usual distance between the curves of a highway, m."""
SWING = np.radians(25.0)
"""Largest heading of a highway against the straight line between its ends, rad."""
WOBBLE = 0.1
"""Largest displacement of a district along each axis, as a share of their distance."""


class Highway(NamedTuple):
    """Nodes at its ends, (V, 2) m vertices, (V,) m radii of the curves at them, 0 at the ends."""

    begin: int
    end: int
    line: Floats
    radius: Floats


class _Join(NamedTuple):
    """Two districts, the nodes of each that a highway joins, and its shape: (V,) vertices from 0 to 1, complex."""

    towns: tuple[int, int]
    gates: tuple[int, int]
    shape: NDArray[np.complex128]


def spread(
    towns: list[Floats], shape: tuple[int, int], highways_m: float, tightest_m: float, rng: Rng
) -> tuple[Floats, list[Highway]]:
    """Nodes (N, 2) m of all districts, apart from each other, and highways of highways_m between neighbours.

    towns: nodes (n, 2) m of each district around its middle; shape: rows and columns of districts.
    """
    middle = np.stack(np.divmod(np.arange(len(towns)), shape[1])[::-1], axis=-1).astype(np.float64)
    middle += rng.uniform(-WOBBLE, WOBBLE, middle.shape)
    middle -= middle.mean(axis=0)
    joins = _joins(towns, shape, middle, highways_m, tightest_m, rng)
    apart = _apart(towns, joins, middle, highways_m)
    nodes = np.concatenate([town + place for town, place in zip(towns, middle * apart, strict=True)])
    begin = np.concatenate(([0], np.cumsum([len(town) for town in towns])))
    highways = []
    for join in joins:
        ends = [int(begin[town]) + gate for town, gate in zip(join.towns, join.gates, strict=True)]
        start, chord = complex(*nodes[ends[0]]), complex(*(nodes[ends[1]] - nodes[ends[0]]))
        points = start + chord * join.shape
        line = np.stack((points.real, points.imag), axis=-1)
        line[0], line[-1] = nodes[ends[0]], nodes[ends[1]]
        highways.append(Highway(ends[0], ends[1], line, _radii(line, tightest_m, rng)))
    return nodes, highways


def _joins(
    towns: list[Floats], shape: tuple[int, int], middle: Floats, highways_m: float, tightest_m: float, rng: Rng
) -> list[_Join]:
    """Neighbours in rows, then in columns; each gate is used once, where a district has enough of them."""
    number = np.arange(len(towns)).reshape(shape)
    pairs = [*zip(number[:, :-1].ravel().tolist(), number[:, 1:].ravel().tolist(), strict=True)]
    pairs += [*zip(number[:-1].ravel().tolist(), number[1:].ravel().tolist(), strict=True)]
    each_m = highways_m / max(len(pairs), 1)
    segments = max(round(each_m / SEGMENT_M), 2)
    used: list[set[int]] = [set() for _ in towns]
    joins = []
    for pair in pairs:
        gates = tuple(
            _gate(towns[here], middle[there] - middle[here], used[here], rng) for here, there in (pair, pair[::-1])
        )
        joins.append(_Join(pair, (gates[0], gates[1]), _winding(segments, each_m / segments, tightest_m, rng)))
    return joins


def _gate(town: Floats, towards: Floats, used: set[int], rng: Rng) -> int:
    """A node far out on the side of a district towards another, not used yet."""
    order = np.argsort(-(town @ towards / np.linalg.norm(towards)) + rng.uniform(0.0, 50.0, len(town))).tolist()
    gate: int = next((node for node in order if node not in used), order[0])
    used.add(gate)
    return gate


def _apart(towns: list[Floats], joins: list[_Join], middle: Floats, highways_m: float) -> float:
    """Distance m of neighbouring districts at which the highways have their length."""
    least = 2 * max(float(np.linalg.norm(town, axis=1).max()) for town in towns) + BETWEEN_M
    if not joins:
        return least
    winds = np.array([np.abs(np.diff(join.shape)).sum() for join in joins])
    between = np.array([middle[join.towns[1]] - middle[join.towns[0]] for join in joins])
    offset = np.array([towns[join.towns[1]][join.gates[1]] - towns[join.towns[0]][join.gates[0]] for join in joins])
    apart = least + highways_m / len(joins)
    for _ in range(6):
        length = float(np.linalg.norm(between * apart + offset, axis=1) @ winds)
        apart = max(apart + (highways_m - length) / len(joins), least)
    return apart


def _winding(segments: int, segment_m: float, tightest_m: float, rng: Rng) -> NDArray[np.complex128]:
    """(segments + 1,) vertices from 0 to 1 that swing to both sides as curves of tightest_m leave room for."""
    swing = min(SWING, float(np.arctan(0.25 * segment_m / tightest_m)))
    steps = rng.uniform(0.8, 1.2, segments) * np.exp(1j * rng.uniform(-swing, swing, segments))
    line = np.concatenate(([0.0], np.cumsum(steps)))
    result: NDArray[np.complex128] = line / line[-1]
    return result


def _radii(line: Floats, tightest_m: float, rng: Rng) -> Floats:
    """(V,) m, one to three times tightest_m as the segments leave room for; 0 at both ends."""
    step = np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1)
    heading = np.arctan2(step[:, 1], step[:, 0])
    half = np.abs(np.angle(np.exp(1j * np.diff(heading)))) / 2
    room = 0.4 * np.minimum(length[1:], length[:-1]) / np.maximum(np.tan(half), 1e-9)
    radius = np.zeros(len(line))
    radius[1:-1] = np.minimum(tightest_m * rng.uniform(1.0, 3.0, len(half)), np.maximum(room, tightest_m))
    return radius
