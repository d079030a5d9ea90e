"""A road network: streets and highways with tunnels, bridges, canyons ... over hills, built once for many drives."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Fraction, NonNegative, check_order
from sensors.errors import EgolocError
from sensors.simulate.environment import Environment
from sensors.simulate.fields import Waves, gentle, hills, map_errors
from sensors.simulate.noise import stream
from sensors.simulate.streets import Blocks, Graph, lay_out
from sensors.simulate.stretches import Stretches, ground_slope, lay_stretches
from sensors.simulate.turns import Turns, turns_of

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

HIGHWAY_M = 8000.0
"""Usual length of a highway in a network without streets, m."""


class NetworkPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a random road network is made of; its environments say which of its roads are what, and how fast."""

    length_km: Annotated[float, msgspec.Meta(ge=20.0, le=20_000.0)] = 1000.0
    """Length of all its roads, km; with highways it has four districts at least, whose streets may make it longer."""
    district_km: Annotated[float, msgspec.Meta(ge=5.0, le=20_000.0)] = 25.0
    """Streets in a district, km; highways join the districts."""
    block_min_m: Annotated[float, msgspec.Meta(ge=40.0, le=2000.0)] = 60.0
    """Shortest street between junctions, m."""
    block_max_m: Annotated[float, msgspec.Meta(ge=40.0, le=2000.0)] = 350.0
    """Longest street between junctions, m."""
    missing: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.1
    """Share of the streets that is left out, -."""
    bent: Fraction = 0.3
    """Share of the streets with a bend, -."""
    straight_on: Annotated[float, msgspec.Meta(ge=0.01, le=100.0)] = 3.0
    """At a crossing, how much likelier than a turn it is to go straight on, -."""
    turn_radius_min_m: Annotated[float, msgspec.Meta(ge=4.0, le=100.0)] = 8.0
    """Tightest 90 degree turn, m."""
    turn_radius_max_m: Annotated[float, msgspec.Meta(ge=4.0, le=100.0)] = 25.0
    """Widest 90 degree turn, m."""
    ramp_radius_m: Annotated[float, msgspec.Meta(ge=8.0, le=500.0)] = 50.0
    """90 degree turn from or onto a highway, as the streets leave room for, m."""
    stop_min_s: NonNegative = 5.0
    """Shortest red light, s of complete rest."""
    stop_max_s: NonNegative = 30.0
    """Longest red light, s of complete rest."""
    crossfall_max: Annotated[float, msgspec.Meta(ge=0.0, le=0.1)] = 0.02
    """Largest crossfall of the road, m/m."""

    def __post_init__(self) -> None:
        for name in ("block_{}_m", "turn_radius_{}_m", "stop_{}_s"):
            check_order(self, name.format("min"), name.format("max"))


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Roads in a plane, x east, y north in metres, and what lies along them.

    A place on it is a place on the line, all edges laid end to end: edge e is line[e] .. line[e + 1] (E + 1,) m.
    setback: (N,) m from a junction at which a turn of 90 degrees begins; junction: (N,) bool, three roads or more;
    ground: heights m over the plane's origin; crossfall: left side up, m/m; map_errors: along, left and in yaw, each of
    unit variance.
    """

    plan: NetworkPlan
    graph: Graph
    line: Floats
    setback: Floats
    junction: NDArray[np.bool_]
    stretches: Stretches
    names: tuple[str, ...]
    environments: tuple[Environment, ...]
    ground: Waves
    crossfall: Waves
    map_errors: tuple[Waves, Waves, Waves]
    turns: Turns

    @property
    def length_m(self) -> float:
        """All edges, m."""
        return float(self.line[-1])


def build_network(plan: NetworkPlan, environments: Mapping[str, Environment], seed: int) -> Network:
    """The network of a seed; the latest few are kept, so that all drives of a process share one."""
    return _built(plan, tuple(environments.items()), seed)


@lru_cache(maxsize=4)
def _built(plan: NetworkPlan, named: tuple[tuple[str, Environment], ...], seed: int) -> Network:
    present = [(name, environment) for name, environment in named if environment.share > 0]
    if not present:
        raise EgolocError("environments: expected at least one with a share above 0")
    names, environments = (tuple(column) for column in zip(*present, strict=True))
    rng = stream(seed, "network")
    graph = _graph(plan, environments, rng)
    lengths = graph.lengths()
    degree = np.bincount(graph.ends.ravel(), minlength=len(graph.nodes))
    setback = rng.uniform(plan.turn_radius_min_m, plan.turn_radius_max_m, len(graph.nodes))
    ramps = np.unique(graph.ends[graph.highway])
    setback[ramps] = np.maximum(setback[ramps], plan.ramp_radius_m)
    return Network(
        plan=plan,
        graph=graph,
        line=np.concatenate(([0.0], np.cumsum(lengths))),
        setback=setback,
        junction=degree > 2,
        stretches=lay_stretches(lengths, _roads(graph), graph.highway, environments, rng),
        names=names,
        environments=environments,
        ground=hills(ground_slope(environments), rng),
        crossfall=gentle(plan.crossfall_max, rng),
        map_errors=map_errors(rng),
        turns=turns_of(graph, plan.straight_on),
    )


def _graph(plan: NetworkPlan, environments: tuple[Environment, ...], rng: np.random.Generator) -> Graph:
    """Streets and highways in the proportion of the environments that lie on nothing else."""
    streets = sum(e.share for e in environments if e.road.on == "streets")
    highways = sum(e.share for e in environments if e.road.on == "highways")
    total_m = plan.length_km * 1000.0
    # where everything may lie anywhere, all roads are streets
    highways_m = total_m * highways / (streets + highways) if highways else 0.0
    streets_m = total_m - highways_m if streets or not highways else 0.0
    districts = streets_m / (plan.district_km * 1000.0) if streets_m else highways_m / HIGHWAY_M / 1.7
    blocks = Blocks(plan.block_min_m, plan.block_max_m, plan.missing, plan.bent)
    count = max(round(districts), 4) if highways else 1
    return lay_out(blocks, streets_m, highways_m, count, _tightest(environments), rng)


def _tightest(environments: tuple[Environment, ...]) -> tuple[float, float]:
    """Radius m of curves between junctions that every environment of streets, and of highways, allows."""
    radii = [
        max((e.road.curve_radius_min_m for e in environments if e.road.on in ("any", on)), default=100.0)
        for on in ("streets", "highways")
    ]
    return radii[0], radii[1]


def _roads(graph: Graph) -> Ints:
    """(E,) number of the road: streets that begin where the one before ended go on with it; highways stand alone."""
    ends, highway = graph.ends, graph.highway
    apart = (ends[1:, 0] != ends[:-1, 1]) | highway[1:]
    return np.concatenate(([0], np.cumsum(apart)))
