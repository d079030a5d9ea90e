"""A drive's way over a road network: a walk over its roads as a Route, what lies along it, and its heights."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.corners import Corners, Curves, round_off
from sensors.simulate.network import Network
from sensors.simulate.noise import stream
from sensors.simulate.route import Route

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rng = np.random.Generator

OPEN_AHEAD_M = 300.0
"""A drive begins at least this far before a place without any sky, where the roads leave a choice, m."""
BEFORE_CORNER_M = 40.0
"""No drive begins nearer to the end of a straight, where that is long enough, m."""
STOP_LINE_M = 5.0
"""A red light stops a drive this far before its turn begins, m."""
APART_M = 20.0
"""A light nearer to the start or to the one before is green, m."""
SLOPE_STEP_M = 10.0
"""Spacing of grade and crossfall along a route, m."""
TRIES = 100


@dataclass(frozen=True, slots=True, eq=False)
class Itinerary:
    """A route that begins at xy (2,) m in a network's plane.

    edges: (M + 1,) m of the route, kind: (M,): stretches of one environment; height: (G,) m over the plane's origin at
    route.slope_at.
    """

    network: Network
    way: "Way"
    curves: Curves
    route: Route
    edges: Floats
    kind: Ints
    height: Floats

    def place(self, s: Floats) -> Floats:
        """(N, 2) m in the network's plane at s (N,) m."""
        place: Floats = self.way.corners.xy[0] + self.route.place(s, self.curves.heading)
        return place

    def line(self, s: Floats) -> Floats:
        """(N,) m on the network's line at s (N,) m: of the place on the road that the route rounds off there."""
        return self.way.line(self.network, np.interp(s, self.curves.rounded, self.curves.polyline))


class Way(NamedTuple):
    """Roads (R,) with a direction, the places (R + 1,) m along the polyline where they begin, below 0 for the first.

    node: (C,) nodes at the corners, -1 where there is none; piece: (T,) rows of the network's pieces of road in order,
    piece_at: (T,) m along the polyline where they begin.
    """

    roads: Ints
    begins: Floats
    corners: Corners
    node: Ints
    piece: Ints
    piece_at: Floats

    def line(self, network: Network, at: Floats) -> Floats:
        """(N,) m on the network's line at places (N,) m along the polyline."""
        step = _within(self.begins[:-1], at)
        edge, back = self.roads[step] // 2, self.roads[step] % 2
        into = at - self.begins[step]
        result: Floats = np.where(back, network.line[edge + 1] - into, network.line[edge] + into)
        return result


def itinerary(network: Network, length_m: float, seed: int) -> Itinerary:
    """The way of a seed, at least length_m long; a longer one begins with the shorter one.

    It begins anywhere on the network, every metre as likely as any other, so that over many drives the environments
    are driven in proportion to their kilometres.
    """
    # curves cut corners: a way is shorter than its roads
    way = _way(network, *_walk(network, 1.1 * length_m + 1000.0, stream(seed, "route")))
    curves = round_off(way.corners)
    piece_at = np.maximum(np.interp(way.piece_at, curves.polyline, curves.rounded), 0.0)
    kind = network.stretches.kind[way.piece]
    edges = np.union1d(curves.edges, piece_at)
    stop_at, stop_for = _red_lights(network, way, curves, piece_at, stream(seed, "lights"))
    slope_at = np.arange(0.0, edges[-1], SLOPE_STEP_M)
    level = np.zeros(len(slope_at))
    route = Route(
        edges=edges,
        curvature=curves.curvature[_within(curves.edges[:-1], edges[:-1])],
        speed_limit=network.stretches.speed_limit[way.piece[_within(piece_at, edges[:-1])]],
        stop_at=stop_at,
        stop_for=stop_for,
        slope_at=slope_at,
        grade=level,
        crossfall=level,
    )
    change = np.flatnonzero(np.diff(kind, prepend=-1))
    found = Itinerary(network, way, curves, route, np.append(piece_at[change], edges[-1]), kind[change], level)
    return _over_hills(found)


def _over_hills(found: Itinerary) -> Itinerary:
    """The same with heights, grade and crossfall."""
    network, s = found.network, found.route.slope_at
    xy = found.place(s)
    height = network.ground.at(xy) + network.stretches.above_ground(found.line(s))
    grade = np.arctan(np.gradient(height, SLOPE_STEP_M))
    crossfall = np.arctan(network.crossfall.at(xy))
    return replace(found, route=replace(found.route, grade=grade, crossfall=crossfall), height=height)


def _walk(network: Network, length_m: float, rng: Rng) -> tuple[Ints, float]:
    """Directed edges from one that begins skipped m before the start, on over length_m, and skipped."""
    lengths = np.diff(network.line)
    for _ in range(TRIES):
        line = rng.uniform(0.0, network.length_m)
        edge, back = int(_within(network.line[:-1], np.array([line]))[0]), int(rng.integers(2))
        skipped = float(network.line[edge + 1] - line if back else line - network.line[edge])
        begin = network.turns.walk(2 * edge + back, lengths, OPEN_AHEAD_M, rng)
        if not _blocked(network, begin, skipped):
            break
    rest = network.turns.walk(int(begin[-1]), lengths, length_m, rng)
    return np.concatenate((begin, rest[1:])), skipped


def _blocked(network: Network, roads: Ints, skipped: float) -> bool:
    """Some of the first OPEN_AHEAD_M of a way have no sky at all."""
    rows, begins = _pieces(network, roads)
    ahead = (begins < skipped + OPEN_AHEAD_M) & (np.append(begins[1:], np.inf) > skipped)
    kinds = set(network.stretches.kind[rows[ahead]].tolist())
    return any(network.environments[kind].sky.blocked for kind in kinds)


def _way(network: Network, roads: Ints, skipped: float) -> Way:
    """Corners and pieces of road along a walk, from skipped m after its beginning."""
    graph = network.graph
    count = np.diff(graph.first) - 1
    rows, step, within = _rows(graph.first[:-1], graph.first[1:] - 1, count, roads)
    head = graph.ends[roads[-1] // 2, 1 - roads[-1] % 2]
    xy = np.concatenate((graph.vertices[rows], graph.nodes[[head]]))
    tail = graph.ends[roads // 2, roads % 2]
    node = np.append(np.where(within == 0, tail[step], -1), head)
    curve = np.append(graph.radius[rows], 0.0)
    at = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))))
    first = int(_within(at[:-1], np.array([skipped]))[0])
    # as far from the end of the straight as it allows
    ahead = at[first + 1] - at[first]
    skipped = max(min(skipped, at[first + 1] - min(BEFORE_CORNER_M, ahead / 2)), at[first])
    xy, node, curve = xy[first:], node[first:], curve[first:]
    xy[0] += (xy[1] - xy[0]) * (skipped - at[first]) / ahead
    node[0] = -1
    pieces, begins = _pieces(network, roads)
    here = np.append(begins[1:], np.inf) > skipped
    road_at = np.append(at[np.flatnonzero(within == 0)], at[-1])
    setback = np.where(node >= 0, network.setback[node], 0.0)
    return Way(roads, road_at - skipped, Corners(xy, curve, setback), node, pieces[here], begins[here] - skipped)


def _pieces(network: Network, roads: Ints) -> tuple[Ints, Floats]:
    """(T,) rows of the pieces of road along a walk, and where each begins, m along the walk."""
    at = network.stretches.at
    first = np.searchsorted(at, network.line)
    rows, _, _ = _rows(first[:-1], first[1:] - 1, np.diff(first), roads)
    begins = np.concatenate(([0.0], np.cumsum(at[rows + 1] - at[rows])[:-1]))
    return rows, begins


def _rows(first: Ints, last: Ints, count: Ints, roads: Ints) -> tuple[Ints, Ints, Ints]:
    """Rows of a table from the first row of each edge on, or from its last row back; the step of the walk and the row's
    number in it."""
    edge, back = roads // 2, roads % 2
    begin, sign = np.where(back, last[edge], first[edge]), 1 - 2 * back
    step = np.repeat(np.arange(len(roads)), count[edge])
    within = np.arange(len(step)) - np.repeat(np.cumsum(count[edge]) - count[edge], count[edge])
    return begin[step] + sign[step] * within, step, within


def _red_lights(network: Network, way: Way, curves: Curves, piece_at: Floats, rng: Rng) -> tuple[Floats, Floats]:
    """Places m and waiting times s of red lights, by the environment that a junction is reached in."""
    corner = np.flatnonzero((way.node >= 0) & network.junction[way.node])
    corner = corner[(corner > 0) & (corner < len(way.node) - 1)]
    at = curves.begins[corner] - STOP_LINE_M
    probability = np.array([e.road.stop_probability for e in network.environments])
    kind = network.stretches.kind[way.piece[_within(piece_at, at)]]
    draws = rng.random((len(corner), 2))
    red = (draws[:, 0] < probability[kind]) & (np.diff(at, prepend=0.0) > APART_M)
    plan = network.plan
    return at[red], plan.stop_min_s + (plan.stop_max_s - plan.stop_min_s) * draws[red, 1]


def _within(begins: Floats, at: Floats) -> Ints:
    """(N,) index of the interval that holds each place (N,), by the intervals' begins."""
    return np.maximum(np.searchsorted(begins, at, side="right") - 1, 0)
