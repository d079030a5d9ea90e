"""Where the signals and objects of an OpenDRIVE road stand: a point with a heading, and shapes around it."""

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from sensors.maps.hardened_xml import mistake, number
from sensors.maps.opendrive_road import Road
from sensors.maps.vector_map import Floats

BEYOND_M = 1.0
"""Signals this far beyond the end of their road are mistakes; nearer ones come from rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Foot (3,) m and heading rad of something, in the file's coordinates."""

    foot: Floats
    heading: float

    def around(self, u: ArrayLike, v: ArrayLike, z: ArrayLike) -> Floats:
        """(n, 3) points that lie u ahead, v to the left and z above."""
        ahead, left, above = np.broadcast_arrays(u, v, z)
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        turned: Floats = np.column_stack((cos * ahead - sin * left, sin * ahead + cos * left, above))
        return self.foot + turned

    def box(self, length: float, width: float) -> Floats:
        """(5, 3) closed ring that is length long ahead and width wide across, around the foot."""
        u, v = 0.5 * length * np.array([1, 1, -1, -1, 1]), 0.5 * width * np.array([1, -1, -1, 1, 1])
        return self.around(u, v, 0.0)

    def face(self, width: float, height: float) -> Floats:
        """(5, 3) closed ring upright across the heading, its lower edge at the foot."""
        return self.around(0.0, 0.5 * width * np.array([1, -1, -1, 1, 1]), height * np.array([0, 0, 1, 1, 0]))

    def upright(self, height: float) -> Floats:
        """(2, 3) foot and top; (1, 3) the foot alone where the height is not known."""
        return self.around(0.0, 0.0, np.array([0.0, height] if height > 0.0 else [0.0]))


def on_road(road: Road, s: float, t: float, above: float, turn: float) -> Place:
    """The place at (s, t), above the road's surface there, turned from the road's heading (m, rad)."""
    at = np.array([s])
    foot = road.surface.points(at, np.array([t]), np.array([above]))[0]
    return Place(foot, float(road.surface.plan.at(at)[0, 2]) + turn)


def is_beyond(road: Road, s: float) -> bool:
    """Is s off the road's ends?"""
    return not -BEYOND_M <= s <= road.surface.length + BEYOND_M


def signal_place(signal: Element, road: Road, roads: Mapping[str, Road]) -> tuple[Place, Road, float, float]:
    """A signal's place, and the road, s and t where it stands: another one than its own where it says so."""
    inertial, elsewhere = signal.find("positionInertial"), signal.find("positionRoad")
    s, t = number(signal, "s"), number(signal, "t")
    if inertial is not None:
        foot = np.array([number(inertial, key, None if key != "z" else 0.0) for key in "xyz"])
        return Place(foot, number(inertial, "hdg", 0.0)), road, s, t
    if elsewhere is None:
        place = on_road(road, s, t, number(signal, "zOffset", 0.0), number(signal, "hOffset", 0.0))
        return place, road, s, t
    there = roads.get(elsewhere.get("roadId", ""))
    if there is None:
        raise mistake(elsewhere, f"roadId: expected a road of this file, got {elsewhere.get('roadId')!r}")
    s, t = number(elsewhere, "s"), number(elsewhere, "t")
    place = on_road(there, s, t, number(elsewhere, "zOffset", 0.0), number(elsewhere, "hOffset", 0.0))
    return place, there, s, t
