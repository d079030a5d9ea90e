"""What a stretch of road is like for its driver, for GNSS and for map matching: city, highway, tunnel, canyon ...

An environment's name is the scene tag that travels in the log. Rates add to what sensors do anywhere.
"""

from typing import Annotated, Literal

import msgspec

from sensors.bounds import Finite, Fraction, NonNegative, Positive, check_order


class Sky(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What GNSS sees."""

    blocked: bool = False
    """No signal at all (tunnel)."""
    lost_per_hour: NonNegative = 0.0
    """How often the solution is lost, 1/h."""
    float_per_hour: NonNegative = 0.0
    """How often a fixed solution falls back to float, 1/h."""
    multipath_per_hour: NonNegative = 0.0
    """How often reflections displace the solution for seconds, 1/h."""
    multipath_m: NonNegative = 0.0
    """Scale of that displacement, m."""
    wrong_fix_per_hour: NonNegative = 0.0
    """How often ambiguities are fixed wrongly: metres off with a centimetre sigma, 1/h."""


class Landmarks(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What map matching finds to hold on to."""

    scarcity: Positive = 1.0
    """Longitudinal sigma times this, -."""
    degenerate_per_km: NonNegative = 0.0
    """Stretches with nothing that tells where along the road one is, 1/km."""
    degenerate_m: Positive = 60.0
    """Mean length of these stretches, m."""
    dash_alias_per_km: NonNegative = 0.0
    """Places where the matcher locks onto the next lane dash, 1/km."""
    lane_alias_per_km: NonNegative = 0.0
    """Places where it locks onto the next lane, 1/km."""
    dash_twin_per_km: NonNegative = 0.0
    """Places where the next lane dash is the weaker of two modes: the fix is right, and tells both, 1/km."""
    lane_twin_per_km: NonNegative = 0.0
    """The same with the next lane, 1/km."""


class Road(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the road runs and is driven."""

    on: Literal["streets", "highways", "any"] = "streets"
    """Which roads of a network have such stretches: the streets of districts, the highways between them, or both."""
    speed_limits: Annotated[tuple[Positive, ...], msgspec.Meta(min_length=1)] = (8.3, 11.1, 13.9)
    """One is drawn for each road, m/s."""
    stop_probability: Fraction = 0.3
    """A junction's light is red, -."""
    grade_max: Fraction = 0.04
    """Steepest grade, m/m."""
    curve_radius_min_m: Positive = 60.0
    """Tightest curve between junctions, m."""
    rise_m: Finite = 0.0
    """Height over the ground in the middle of a block (bridge; negative: underpass), as far as grade_max allows, m."""


class Environment(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of stretch."""

    share: NonNegative = 1.0
    """Its share of the network's kilometres, relative to the others'; 0: nowhere."""
    length_min_m: Positive = 100.0
    """Shortest stretch, m."""
    length_max_m: Positive = 2000.0
    """Longest stretch, m."""
    road: Road = Road()
    sky: Sky = Sky()
    landmarks: Landmarks = Landmarks()

    def __post_init__(self) -> None:
        check_order(self, "length_min_m", "length_max_m")
