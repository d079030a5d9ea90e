"""Environments laid onto roads: each gets its share of the kilometres, in stretches of its range of lengths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.environment import Environment

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rng = np.random.Generator

GROUND_SHARE = 0.7
"""Steepest slope of the ground over the steepest grade of the environments, -."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Pieces of road, no longer than a block, along the line of all edges laid end to end.

    at: (P + 1,) m on the line; kind: (P,) environment; speed_limit: (P,) m/s; rise: (P,) m, of the road's middle there
    over the ground.
    """

    at: Floats
    kind: Ints
    speed_limit: Floats
    rise: Floats

    def piece(self, line: Floats) -> Ints:
        """(N,) index of the piece at places on the line (N,) m."""
        return np.clip(np.searchsorted(self.at, line, side="right") - 1, 0, len(self.kind) - 1)

    def above_ground(self, line: Floats) -> Floats:
        """(N,) m: a crest or dip on every piece with a rise, level with the ground at both of its ends."""
        piece = self.piece(line)
        into = (line - self.at[piece]) / (self.at[piece + 1] - self.at[piece])
        above: Floats = self.rise[piece] * np.sin(np.pi * into) ** 2
        return above


def lay_stretches(
    lengths: Floats, roads: Ints, highway: NDArray[np.bool_], environments: tuple[Environment, ...], rng: Rng
) -> Stretches:
    """Stretches over edges (E,) m; edges of one road (the same number in roads) follow each other."""
    line = np.concatenate(([0.0], np.cumsum(lengths)))
    first = np.flatnonzero(np.diff(roads, prepend=-1))
    begin, end = line[first], line[np.append(first[1:], len(lengths))]
    at: list[float] = []
    kind: list[int] = []
    for on, chosen in (("streets", ~highway), ("highways", highway)):
        rows = np.flatnonzero(chosen[first])
        part = float(lengths[chosen].sum() / line[-1])
        weight = np.array([e.share * {on: 1.0, "any": part}.get(e.road.on, 0.0) for e in environments])
        if len(rows):
            _deal(begin[rows], end[rows], weight, environments, rng, at, kind)
    order = np.argsort(at)
    starts, kinds = np.array(at)[order], np.array(kind, np.intp)[order]
    limits = np.array([rng.choice(environments[k].road.speed_limits) for k in kinds])
    cuts = np.union1d(line[:-1], starts)
    stretch = np.searchsorted(starts, cuts, side="right") - 1
    pieces = np.append(cuts, line[-1])
    return Stretches(pieces, kinds[stretch], limits[stretch], _rises(np.diff(pieces), kinds[stretch], environments))


def _deal(
    begin: Floats,
    end: Floats,
    weight: Floats,
    environments: tuple[Environment, ...],
    rng: Rng,
    at: list[float],
    kind: list[int],
) -> None:
    """Append begin m and environment of stretches that fill roads begin..end (R,), roads in random order.

    An environment with less than half of the kilometres does not follow itself, so its stretches keep their range; the
    last one of a road takes what is too short for another, and roads too short for any are one stretch.
    """
    least, most = (np.array([getattr(e, name) for e in environments]) for name in ("length_min_m", "length_max_m"))
    left = weight / weight.sum() * float((end - begin).sum())
    common = weight > 0.5 * weight.sum()
    shortest = least[weight > 0].min()
    for road in rng.permutation(len(begin)):
        place, stop, last = begin[road], end[road], -1
        while place < stop:
            chance = np.maximum(left, 0.0) / (least + most)
            if last >= 0 and not common[last]:
                chance[last] = 0.0
            fitting = np.where(least <= stop - place, chance, 0.0)
            for candidates in (fitting, chance, weight):
                if candidates.sum() > 0:
                    break
            last = int(np.searchsorted(np.cumsum(candidates), rng.random() * candidates.sum(), side="right"))
            length = rng.uniform(least[last], most[last])
            if stop - place - length < shortest:
                length = stop - place
            at.append(float(place))
            kind.append(last)
            left[last] -= length
            place += length


def _rises(lengths: Floats, kind: Ints, environments: tuple[Environment, ...]) -> Floats:
    """(P,) m, so that the ground's slope and the crest's together stay within the environment's steepest grade."""
    rise = np.array([e.road.rise_m for e in environments])[kind]
    steepest = np.array([e.road.grade_max for e in environments])[kind]
    room = (steepest - ground_slope(environments)) * lengths / np.pi
    clipped: Floats = np.clip(rise, -room, room)
    return clipped


def ground_slope(environments: tuple[Environment, ...]) -> float:
    """Steepest slope of the ground, -: what every environment allows, with something left for crests and dips."""
    return GROUND_SHARE * min(e.road.grade_max for e in environments)
