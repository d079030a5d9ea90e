"""Where a drive goes: a route as columns over arc length (a road network can yield the same), and a random city one."""

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Fraction, NonNegative, Positive, check_order

Floats = NDArray[np.float64]
Rng = np.random.Generator

WAVES = 6
"""Sinusoids in the elevation and in the crossfall of a city route."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A lane to follow, over arc length from its start.

    edges: (M + 1,) m, where elements begin and end; curvature: (M,) 1/m, left positive; speed_limit: (M,) m/s;
    stop_at: (S,) m, increasing; stop_for: (S,) s of complete rest;
    slope_at: (G,) m; grade: (G,) rad, uphill positive; crossfall: (G,) rad of roll, left side up.
    """

    edges: Floats
    curvature: Floats
    speed_limit: Floats
    stop_at: Floats
    stop_for: Floats
    slope_at: Floats
    grade: Floats
    crossfall: Floats

    def heading(self, s: Floats) -> Floats:
        """(N,) heading at s against that at the start, rad."""
        turned = np.concatenate(([0.0], np.cumsum(self.curvature * np.diff(self.edges))))
        return np.interp(s, self.edges, turned)

    def place(self, s: Floats, heading: float = 0.0) -> Floats:
        """(N, 2) m from the start to s (N,) in the plane; heading: rad at the start, ccw from the first axis."""
        return place_along(self.edges, self.curvature, s, heading)

    def element(self, s: Floats) -> NDArray[np.intp]:
        """(N,) index of the element at s."""
        return _element(self.edges, s)


def place_along(edges: Floats, curvature: Floats, s: Floats, heading: float) -> Floats:
    """(N, 2) m from the start of straights and arcs to s (N,); edges: (M + 1,) m, curvature: (M,) 1/m, heading: rad."""
    lengths = np.diff(edges)
    turned = curvature * lengths
    begins = heading + np.concatenate(([0.0], np.cumsum(turned)[:-1]))
    corners = np.zeros((len(lengths), 2))
    corners[1:] = np.cumsum(_chord(lengths, turned, begins), axis=0)[:-1]
    at = _element(edges, s)
    into = s - edges[at]
    return corners[at] + _chord(into, curvature[at] * into, begins[at])


def _element(edges: Floats, s: Floats) -> NDArray[np.intp]:
    return np.clip(np.searchsorted(edges, s, side="right") - 1, 0, len(edges) - 2)


def _chord(length: Floats, turned: Floats, begin: Floats) -> Floats:
    """(N, 2) m from begin to end of arcs of a length m that turn by an angle rad from their heading at the begin."""
    straight = length * np.sinc(turned / (2 * np.pi))
    middle = begin + turned / 2
    return np.stack((straight * np.cos(middle), straight * np.sin(middle)), axis=-1)


class CityPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a random city route is made of: blocks of straight road that end in a turn, a bend or a crossing."""

    block_min_m: Annotated[float, msgspec.Meta(ge=20.0)] = 60.0
    """Shortest straight between junctions, m."""
    block_max_m: Positive = 350.0
    """Longest straight between junctions, m."""
    turn_probability: Fraction = 0.45
    """A block ends in a 90 degree turn, -."""
    bend_probability: Fraction = 0.3
    """A block ends in a bend of up to 60 degrees; otherwise the road goes straight on, -."""
    turn_radius_min_m: Positive = 8.0
    """Tightest 90 degree turn, m."""
    turn_radius_max_m: Positive = 25.0
    """Widest 90 degree turn, m."""
    bend_radius_min_m: Positive = 40.0
    """Tightest bend, m."""
    bend_radius_max_m: Positive = 250.0
    """Widest bend, m."""
    speed_limits: Annotated[tuple[Positive, ...], msgspec.Meta(min_length=1)] = (8.3, 11.1, 13.9, 15.0)
    """Speeds driven on straights, one drawn for each block, m/s."""
    stop_probability: Fraction = 0.35
    """The light at the end of a block is red, -."""
    stop_min_s: NonNegative = 5.0
    """Shortest red light, s of complete rest."""
    stop_max_s: NonNegative = 30.0
    """Longest red light, s of complete rest."""
    grade_max: Fraction = 0.04
    """Steepest grade of the road, m/m."""
    crossfall_max: Fraction = 0.02
    """Largest crossfall of the road, m/m."""

    def __post_init__(self) -> None:
        for name in ("block_{}_m", "turn_radius_{}_m", "bend_radius_{}_m", "stop_{}_s"):
            check_order(self, name.format("min"), name.format("max"))


def city_route(plan: CityPlan, length_m: float, rng: Rng) -> Route:
    """A random route of at least length_m; a longer one from the same seed begins with the shorter one."""
    grade, crossfall = _waves(plan.grade_max, rng), _waves(plan.crossfall_max, rng)
    lengths, curvatures, limits = [], [], []
    stop_at, stop_for = [], []
    at = 0.0
    while at < length_m:
        straight = _between(rng, plan.block_min_m, plan.block_max_m)
        radius, angle = _junction(plan, rng)
        limit = rng.choice(plan.speed_limits)
        lengths += [straight, abs(angle) * radius]
        curvatures += [0.0, float(np.sign(angle)) / radius]
        limits += [limit, limit]
        red, wait = rng.random() < plan.stop_probability, _between(rng, plan.stop_min_s, plan.stop_max_s)
        if red:
            stop_at.append(at + straight - min(10.0, straight / 2))
            stop_for.append(wait)
        at += straight + abs(angle) * radius
    keep = np.array(lengths) > 0
    slope_at = np.arange(0.0, at + 10.0, 10.0)
    return Route(
        edges=np.concatenate(([0.0], np.cumsum(np.array(lengths)[keep]))),
        curvature=np.array(curvatures)[keep],
        speed_limit=np.array(limits)[keep],
        stop_at=np.array(stop_at),
        stop_for=np.array(stop_for),
        slope_at=slope_at,
        grade=np.arctan(_sum_of(grade, slope_at)),
        crossfall=np.arctan(_sum_of(crossfall, slope_at)),
    )


def _between(rng: Rng, low: float, high: float) -> float:
    return low + (high - low) * rng.random()


def _junction(plan: CityPlan, rng: Rng) -> tuple[float, float]:
    """Radius m and signed angle rad (0: straight on) of what ends a block."""
    kind, side = rng.random(), 1.0 if rng.random() < 0.5 else -1.0
    radius, angle = rng.random(), rng.random()
    if kind < plan.turn_probability:
        return plan.turn_radius_min_m + radius * (plan.turn_radius_max_m - plan.turn_radius_min_m), side * np.pi / 2
    if kind < plan.turn_probability + plan.bend_probability:
        bend = plan.bend_radius_min_m + radius * (plan.bend_radius_max_m - plan.bend_radius_min_m)
        return bend, side * np.radians(10.0 + 50.0 * angle)
    return 1.0, 0.0


def _waves(limit: float, rng: Rng) -> Floats:
    """(3, WAVES) slope amplitude -, wave number 1/m, phase rad of hills 250 m to 3 km long, no steeper than limit."""
    share = 0.5 + rng.random(WAVES)
    wavelength = 250.0 * 12.0 ** rng.random(WAVES)
    return np.stack((limit * share / share.sum(), 2 * np.pi / wavelength, 2 * np.pi * rng.random(WAVES)))


def _sum_of(waves: Floats, s: Floats) -> Floats:
    amplitude, number, phase = waves
    result: Floats = sum((a * np.cos(k * s + p) for a, k, p in zip(amplitude, number, phase, strict=True)), np.zeros(1))
    return result
