"""One drive, planned: the exact motion and the course along the road, before any sensor measures it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.errors import EgolocError
from sensors.rotation import wrap
from sensors.simulate.course import BIAS_STEP_M, Course, bias_along
from sensors.simulate.driver import Driver, Timetable, control_times, profile_along, timetable
from sensors.simulate.environment import Environment
from sensors.simulate.fields import map_errors
from sensors.simulate.following import TrajectoryPlan, follow, steered
from sensors.simulate.itinerary import Itinerary, itinerary
from sensors.simulate.network import Network, NetworkPlan, build_network
from sensors.simulate.noise import stream
from sensors.simulate.plane import Plane
from sensors.simulate.route import CityPlan, city_route
from sensors.simulate.trajectory import CHUNK, KNOT_S, MARGIN_S, Profile, Truth

Floats = NDArray[np.float64]

TAIL_M, TAIL_S = 1000.0, 30.0
"""A route goes on so far behind the end of its drive, and is timed for so long: what lies ahead shapes the speed."""
USUAL_SPEED = 12.0
"""First guess of the mean speed over a network, m/s."""
KEEPING = (0.02, 0.02, 0.005)
"""Shares of the speed by which a drive over a network is corrected along, across and up to keep to its roads."""
KEEPING_S = 10.0
"""Time over which its offsets are averaged: only the drift is corrected, not how a driver rounds off a corner, s."""


class PlannedDrive(NamedTuple):
    """Truth and course reach MARGIN_S beyond both ends of the drive, which lasts duration_s from truth.start_ns on."""

    truth: Truth
    course: Course
    duration_s: float


def plan_drive(
    roads: CityPlan | NetworkPlan | TrajectoryPlan,
    environments: Mapping[str, Environment],
    driver: Driver,
    start_llh: ArrayLike,
    start_ns: int,
    seed: int,
    *,
    network_seed: int = 0,
    duration_s: float | None = None,
    length_km: float | None = None,
) -> PlannedDrive:
    """The drive of a seed on roads of a kind: as long as duration_s, as far as length_km, what ends first.

    roads: a city route of its own for each seed (environment "city"), a network (built once per process from plan,
    environments and network_seed, shared by all seeds), or a trajectory file to follow with its own times and place
    (all of it where neither duration nor length is given; other roads need one of them).
    environments: by scene tag; an empty one means {"city": Environment()}.
    start_llh: (3,) rad, rad, m: centre of a network, first point of a city route; start_ns: Unix time of the start.
    """
    named = dict(environments) or {"city": Environment()}
    longest_s = np.inf if duration_s is None else duration_s
    longest_m = np.inf if length_km is None else 1000.0 * length_km
    trip = _Trip(driver, np.asarray(start_llh, np.float64), start_ns, seed, longest_s, longest_m)
    if isinstance(roads, TrajectoryPlan):
        return _along(roads, named, trip)
    if not np.isfinite(min(longest_s, longest_m)):
        raise EgolocError("simulate: expected a duration or a length of the drive, got neither")
    if isinstance(roads, CityPlan):
        return _through_city(roads, named, trip)
    return _over_network(build_network(roads, named, network_seed), trip)


class _Trip(NamedTuple):
    """Who drives, from where (3,) llh and when, by which seed, and how long at most."""

    driver: Driver
    start_llh: Floats
    start_ns: int
    seed: int
    longest_s: float
    longest_m: float

    def duration_s(self, table: Timetable) -> float:
        """How long a drive by a timetable is."""
        return min(self.longest_s, table.reaches(self.longest_m)) if np.isfinite(self.longest_m) else self.longest_s


def _through_city(plan: CityPlan, environments: Mapping[str, Environment], trip: _Trip) -> PlannedDrive:
    rng = stream(trip.seed, "route")
    yaw = rng.uniform(-np.pi, np.pi)
    fastest_m = max(plan.speed_limits) * (trip.longest_s + 2 * MARGIN_S)
    route = city_route(plan, min(fastest_m, trip.longest_m + TAIL_M), rng)
    table = timetable(route, trip.driver)
    duration_s = trip.duration_s(table)
    truth = Truth(profile_along(route, table, trip.driver, duration_s, yaw), trip.start_llh, trip.start_ns)
    s = table.at(control_times(duration_s))[0][2:-2]
    name = "city" if "city" in environments else next(iter(environments))
    bias_at = _steps(s[-1])
    bias = bias_along(map_errors(stream(trip.seed, "map")), route.place(bias_at, yaw))
    return PlannedDrive(truth, _uniform(truth, s, name, environments[name], bias_at, bias), duration_s)


def _over_network(network: Network, trip: _Trip) -> PlannedDrive:
    plane = Plane(trip.start_llh)
    way, table = _long_enough(network, trip)
    duration_s = trip.duration_s(table)
    s = table.at(control_times(duration_s))[0]
    wanted, stretch = np.empty((len(s), 3)), np.empty((len(s), 2))
    for begin in range(0, len(s), CHUNK):
        rows = slice(begin, begin + CHUNK)
        height = np.interp(s[rows], way.route.slope_at, way.height)
        wanted[rows] = plane.llh(np.column_stack((way.place(s[rows]), height)))
        stretch[rows] = plane.stretch(wanted[rows])
    profile = profile_along(way.route, table, trip.driver, duration_s, way.curves.heading)
    profile = _on_earth(profile, stretch)
    drifting = Truth(profile, wanted[2], trip.start_ns)
    truth = Truth(steered(profile, drifting, wanted[2:-2], KEEPING, KEEPING_S), wanted[2], trip.start_ns)
    bias_at = _steps(s[-1])
    course = Course(
        t_ns=_knots_ns(truth),
        s=s[2:-2],
        names=network.names,
        environments=network.environments,
        edges=way.edges,
        kind=way.kind,
        bias_at=bias_at,
        bias=bias_along(network.map_errors, way.place(bias_at)),
    )
    return PlannedDrive(truth, course, duration_s)


def _along(plan: TrajectoryPlan, environments: Mapping[str, Environment], trip: _Trip) -> PlannedDrive:
    if plan.environment not in environments:
        known = ", ".join(environments)
        raise EgolocError(f"trajectory: environment: expected one of {known}, got {plan.environment!r}")
    truth, duration_s, _ = follow(plan, trip.driver, trip.start_llh, trip.longest_s)
    xyz = Plane(truth.knots[0]).xyz(truth.knots)
    s = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(xyz, axis=0), axis=1))))
    t = np.arange(len(s)) * KNOT_S - MARGIN_S
    longest = float(np.interp(0.0, t, s)) + trip.longest_m
    if s[-1] > longest:
        duration_s = min(duration_s, float(np.interp(longest, s, t)))
    bias_at = _steps(s[-1])
    xy = np.stack([np.interp(bias_at, s, column) for column in xyz.T[:2]], axis=-1)
    bias = bias_along(map_errors(stream(trip.seed, "map")), xy)
    course = _uniform(truth, s, plan.environment, environments[plan.environment], bias_at, bias)
    return PlannedDrive(truth, course, duration_s)


def _uniform(truth: Truth, s: Floats, name: str, environment: Environment, bias_at: Floats, bias: Floats) -> Course:
    """A course with the same surroundings all along; s: (K + 1,) m at the knots."""
    edges, kind = np.array([0.0, max(s[-1], 1.0)]), np.zeros(1, np.intp)
    return Course(_knots_ns(truth), s, (name,), (environment,), edges, kind, bias_at, bias)


def _long_enough(network: Network, trip: _Trip) -> tuple[Itinerary, Timetable]:
    """A way that goes on behind the end of the drive, and its timetable."""
    length_m = min(trip.longest_m, USUAL_SPEED * trip.longest_s) + TAIL_M
    while True:
        way = itinerary(network, length_m, trip.seed)
        table = timetable(way.route, trip.driver)
        if length_m >= trip.longest_m + TAIL_M or table.leaves[-1] >= trip.longest_s + TAIL_S:
            return way, table
        length_m *= 1.3


def _on_earth(profile: Profile, stretch: Floats) -> Profile:
    """A profile in the plane as one on the earth; stretch: (K + 5, 2) of x and of y at the control points."""
    east, north = stretch[:, 0] * np.cos(profile.yaw), stretch[:, 1] * np.sin(profile.yaw)
    yaw = profile.yaw + wrap(np.arctan2(north, east) - profile.yaw)
    return replace(profile, speed=profile.speed * np.hypot(east, north), yaw=yaw)


def _steps(length_m: float) -> Floats:
    return np.arange(0.0, length_m + 2 * BIAS_STEP_M, BIAS_STEP_M)


def _knots_ns(truth: Truth) -> NDArray[np.int64]:
    """(K + 1,) times of the knots."""
    first, _ = truth.span_ns
    result: NDArray[np.int64] = first + np.rint(np.arange(len(truth.knots)) * (KNOT_S * 1e9)).astype(np.int64)
    return result
