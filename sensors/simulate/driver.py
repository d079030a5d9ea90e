"""How a route is driven: a speed for every metre of it, then the control points of a smooth motion over time."""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import NonNegative, Positive
from sensors.simulate import _road_kernels
from sensors.simulate.route import Route
from sensors.simulate.trajectory import KNOT_S, MARGIN_S, Profile

Floats = NDArray[np.float64]

STEP_M = 1.0
"""Spacing of the speed plan along the route."""
SETTLING_S = 2.5
"""A quintic spline rests completely only where six control points in a row do: five knots more than the stop."""


class Driver(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits that the driver keeps."""

    rest_s: NonNegative = 8.0
    """Complete rest before the drive begins, s."""
    acceleration: Positive = 1.8
    """Forward acceleration, m/s^2."""
    braking: Positive = 2.2
    """Deceleration, m/s^2."""
    lateral: Positive = 2.2
    """Lateral acceleration in turns, m/s^2."""
    roll_per_lateral_deg: NonNegative = 0.35
    """Roll of the body, to the outside of a turn, deg per m/s^2."""


@dataclass(frozen=True, slots=True, eq=False)
class Timetable:
    """speed: (R,) m/s at every STEP_M of a route; leaves: (R,) s at which they are left; stops: (S,) rows with a stop,
    rests: (S,) s of it. Between rows the acceleration is constant."""

    speed: Floats
    leaves: Floats
    stops: NDArray[np.intp]
    rests: Floats

    def reaches(self, s: float) -> float:
        """Time s at which a place s m, at which the drive does not stop, is passed."""
        return float(np.interp(s / STEP_M, np.arange(len(self.leaves)), self.leaves))

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Place m and speed m/s at increasing times t (N,) s."""
        s, speed = np.empty(len(t)), np.empty(len(t))
        _road_kernels.ride(STEP_M, self.speed, self.leaves, self.stops, self.rests, t, s, speed)
        return s, speed


def timetable(route: Route, driver: Driver) -> Timetable:
    """The quickest drive within the driver's limits and the route's, from rest."""
    count = int(np.ceil(route.edges[-1] / STEP_M))
    at = np.clip(np.rint(route.stop_at / STEP_M).astype(np.intp), 1, count - 1)
    stops, first = np.unique(np.append(0, at), return_index=True)
    rests = np.append(driver.rest_s, route.stop_for)[first] + SETTLING_S
    speed, leaves = np.empty(count), np.empty(count)
    limits = np.array([driver.acceleration, driver.braking, driver.lateral])
    _road_kernels.plan_speed(
        STEP_M, route.edges, route.curvature, route.speed_limit, stops, rests, limits, speed, leaves
    )
    return Timetable(speed, leaves, stops, rests)


def control_times(duration_s: float) -> Floats:
    """(K + 5,) s of the control points of a drive's Profile."""
    count = round((duration_s + 2 * MARGIN_S) / KNOT_S) + 6
    return np.arange(-2.0, count - 2) * KNOT_S - MARGIN_S


def drive_profile(route: Route, driver: Driver, duration_s: float, yaw: float) -> Profile:
    """Control points of the drive along a route from rest; yaw: rad at its start.

    The control points keep the driver's limits, and so does the spline: it and its derivative are averages of theirs.
    """
    return profile_along(route, timetable(route, driver), driver, duration_s, yaw)


def profile_along(route: Route, table: Timetable, driver: Driver, duration_s: float, yaw: float) -> Profile:
    """Control points of a drive by its timetable."""
    s, speed = table.at(control_times(duration_s))
    lateral = speed**2 * route.curvature[route.element(s)]
    roll = np.interp(s, route.slope_at, route.crossfall) + np.radians(driver.roll_per_lateral_deg) * lateral
    grade = np.interp(s, route.slope_at, route.grade)
    return Profile(start_s=-MARGIN_S, speed=speed, yaw=yaw + route.heading(s), grade=grade, roll=roll)
