"""A road's surface: from (s, t) along and left of the reference line to x, y, z.

The cross-section is turned about the reference line by the superelevation, and lifted in its own plane by crossfall
and shape; elevation lifts it all. The slope along the road does not lean the cross-section. Source: ASAM OpenDRIVE
1.8, section 10 (crossfall: 1.4).
"""

from dataclasses import dataclass, field

import numpy as np

from sensors.maps.road_geometry import PlanView
from sensors.maps.vector_map import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Cubics:
    """Piecewise cubics a + b ds + c ds^2 + d ds^3, ds from start (k,) m, rising; coefficients (k, 4). Zero before."""

    start: Floats = field(default_factory=lambda: np.empty(0))
    coefficients: Floats = field(default_factory=lambda: np.empty((0, 4)))

    def at(self, s: Floats, end: float = np.inf) -> Floats:
        """(n,) values at s (n,); at the end (m) of a stretch, the piece that leads up to it and not the next."""
        if not len(self.start):
            return np.zeros(len(s))
        row = np.searchsorted(self.start, np.minimum(s, end - 1e-6), side="right") - 1
        ds = s - self.start[row]
        a, b, c, d = self.coefficients[row].T
        result: Floats = np.where(row < 0, 0.0, a + ds * (b + ds * (c + ds * d)))
        return result


@dataclass(frozen=True, slots=True, eq=False)
class CrossShape:
    """Height over t as cubics, at rising s (k,), linear in s between them."""

    s: Floats = field(default_factory=lambda: np.empty(0))
    profiles: tuple[Cubics, ...] = ()

    def at(self, s: Floats, t: Floats) -> Floats:
        """(n,) height m at s, t (n,); before the first t the height there."""
        if not self.profiles:
            return np.zeros(len(s))
        heights = np.array([profile.at(np.maximum(t, profile.start[0])) for profile in self.profiles])
        after = np.clip(np.searchsorted(self.s, s, side="right"), 1, max(len(self.s) - 1, 1))
        before, after = after - 1, np.minimum(after, len(self.s) - 1)
        gap = np.maximum(self.s[after] - self.s[before], 1e-9)
        share = np.clip((s - self.s[before]) / gap, 0.0, 1.0)
        column = np.arange(len(s))
        result: Floats = (1.0 - share) * heights[before, column] + share * heights[after, column]
        return result


@dataclass(frozen=True, slots=True, eq=False)
class RoadSurface:
    """What places a point of a road. Profiles are over s: m, and rad for superelevation and crossfall."""

    plan: PlanView
    length: float
    elevation: Cubics = field(default_factory=Cubics)
    superelevation: Cubics = field(default_factory=Cubics)
    crossfall_left: Cubics = field(default_factory=Cubics)
    crossfall_right: Cubics = field(default_factory=Cubics)
    shape: CrossShape = field(default_factory=CrossShape)

    def section(self, s: Floats, t: Floats) -> Floats:
        """(n, 2) level distance left of the reference line and height above it, m, of points (s, t) (n,)."""
        fall = np.where(t > 0.0, self.crossfall_left.at(s), self.crossfall_right.at(s))
        height = self.shape.at(s, t) - np.abs(t) * np.tan(fall)  # positive: the road falls towards its edge
        roll = self.superelevation.at(s)
        cos, sin = np.cos(roll), np.sin(roll)
        return np.column_stack((t * cos - height * sin, t * sin + height * cos))

    def placed(self, s: Floats, lateral: Floats, height: Floats) -> Floats:
        """(n, C, 3) x, y, z at s (n,), level distance to the left and height above the reference line (n, C), m."""
        x, y, heading = self.plan.at(s).T[:, :, None]
        height = self.elevation.at(s)[:, None] + height
        return np.stack((x - np.sin(heading) * lateral, y + np.cos(heading) * lateral, height), axis=-1)

    def points(self, s: Floats, t: Floats, height: Floats) -> Floats:
        """(n, 3) x, y, z of points (s, t), height above the surface there, m."""
        lateral, lift = self.section(s, t)[:, :, None].swapaxes(0, 1)
        return self.placed(s, lateral, lift + height[:, None])[:, 0]

    @property
    def breaks(self) -> Floats:
        """Where a formula gives way to another, s in m."""
        profiles = (self.elevation, self.superelevation, self.crossfall_left, self.crossfall_right)
        return np.concatenate([self.plan.s, self.shape.s, *(profile.start for profile in profiles)])
