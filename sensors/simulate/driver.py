"""How a route is driven: a speed for every metre of it, then the control points of a smooth motion over time."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import NonNegative, Positive
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


def drive_profile(route: Route, driver: Driver, duration_s: float, yaw: float) -> Profile:
    """Control points of the drive along a route from rest; yaw: rad at its start.

    The control points keep the driver's limits, and so does the spline: it and its derivative are averages of theirs.
    """
    s_plan, v_plan, t_plan = _timed(route, driver)
    count = round((duration_s + 2 * MARGIN_S) / KNOT_S) + 6
    t = np.arange(-2.0, count - 2) * KNOT_S - MARGIN_S
    speed = np.interp(t, t_plan, v_plan)
    s = _arc_length(t, s_plan, v_plan, t_plan)
    element = route.element(s)
    lateral = speed**2 * route.curvature[element]
    roll = np.interp(s, route.slope_at, route.crossfall) + np.radians(driver.roll_per_lateral_deg) * lateral
    grade = np.interp(s, route.slope_at, route.grade)
    return Profile(start_s=-MARGIN_S, speed=speed, yaw=yaw + route.heading(s), grade=grade, roll=roll)


def _timed(route: Route, driver: Driver) -> tuple[Floats, Floats, Floats]:
    """Places m, speeds m/s and times s of the plan; between its rows the acceleration is constant."""
    s = np.arange(0.0, route.edges[-1], STEP_M)
    element = route.element(s)
    bend = np.maximum(np.abs(route.curvature[element]), 1e-9)
    squared = np.minimum(route.speed_limit[element] ** 2, driver.lateral / bend)
    stops = np.clip(np.rint(route.stop_at / STEP_M).astype(np.intp), 1, len(s) - 1)
    squared[stops] = squared[0] = 0.0
    # v^2 grows by at most 2 a per metre ahead of, and 2 b per metre behind, any lower limit
    ahead, behind = 2 * driver.acceleration * s, 2 * driver.braking * s
    squared = np.minimum.accumulate(squared - ahead) + ahead
    squared = np.minimum.accumulate((squared + behind)[::-1])[::-1] - behind
    v = np.sqrt(np.maximum(squared, 0.0))
    rest = np.zeros(len(s))
    rest[stops] = route.stop_for + SETTLING_S
    rest[0] = driver.rest_s + SETTLING_S
    leave = np.concatenate(([0.0], np.cumsum(2 * STEP_M / (v[1:] + v[:-1]) + rest[1:]))) + rest[0]
    still = rest > 0
    order = np.argsort(np.concatenate((leave, (leave - rest)[still])), kind="stable")
    rows = np.concatenate((np.arange(len(s)), np.flatnonzero(still)))[order]
    return s[rows], np.where(still, 0.0, v)[rows], np.concatenate((leave, (leave - rest)[still]))[order]


def _arc_length(t: Floats, s_plan: Floats, v_plan: Floats, t_plan: Floats) -> Floats:
    """(N,) place at each time, by constant acceleration between the plan's rows."""
    row = np.clip(np.searchsorted(t_plan, t, side="right") - 1, 0, len(t_plan) - 2)
    into = np.clip(t - t_plan[row], 0.0, t_plan[row + 1] - t_plan[row])
    span = np.maximum(t_plan[row + 1] - t_plan[row], 1e-12)
    slope = (v_plan[row + 1] - v_plan[row]) / span
    result: Floats = s_plan[row] + v_plan[row] * into + 0.5 * slope * into**2
    return result
