"""Along a given trajectory: control points of a motion that passes the places of a file at their times.

Splines round off what they pass, so the control points are steered towards what they have missed, here round by round.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import uniform_filter1d

from sensors.clock import seconds
from sensors.datasets.trajectory_file import read_trajectory
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, meridian_radius, transverse_radius
from sensors.records import Trajectory
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate import _road_kernels
from sensors.simulate.driver import Driver, control_times
from sensors.simulate.plane import Plane
from sensors.simulate.trajectory import KNOT_S, MARGIN_S, Profile, Truth

Floats = NDArray[np.float64]

REST = 0.1
"""Slower than this over KNOT_S the vehicle rests, m/s."""
HEADED = 1.0
"""Slower than this the course says nothing of the heading, m/s."""
SLACK = (0.3, 0.1, 0.05)
"""Shares of the speed by which a round may change it along, across and up."""
ROUNDS = 12
"""Corrections at most; they end where one makes nothing better."""
WITHIN_M = 0.5
"""A trajectory that cannot be followed this closely is refused, m."""


class TrajectoryPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A drive along a given trajectory."""

    file: str
    """TUM, CSV with named columns or Applanix (Boreas), as a replay's --reference takes it; the route and its times."""
    environment: str = "city"
    """What surrounds all of it: one of the environments."""


class Followed(NamedTuple):
    """The motion, how long the file lasts, and the largest distance between them."""

    truth: Truth
    duration_s: float
    off_m: float


def follow(plan: TrajectoryPlan, driver: Driver, start_llh: ArrayLike, longest_s: float = np.inf) -> Followed:
    """The motion along a trajectory file, within WITHIN_M of it all along; a file in map coordinates begins its map at
    start_llh (3,).

    The nose points along the path: a file with attitude says where the vehicle drives backwards, without it always
    drives forwards. Where it pauses, the motion rests exactly.
    """
    trajectory, frame = read_trajectory(Path(plan.file), None)
    if len(trajectory) < 2 or trajectory.t_ns[-1] - trajectory.t_ns[0] < 1_000_000_000:
        raise EgolocError(f"{plan.file}: expected a trajectory of at least 1 s, got {len(trajectory)} rows")
    if frame is None:
        lat, lon, h = np.asarray(start_llh, np.float64).tolist()
        frame = MapFrame("enu", (float(np.degrees(lat)), float(np.degrees(lon)), h))
    return along(trajectory, frame, driver, plan.file, longest_s)


def along(trajectory: Trajectory, frame: MapFrame, driver: Driver, name: str, longest_s: float = np.inf) -> Followed:
    """The motion along a trajectory in a map frame; name: of its source, for errors."""
    path = _Path(trajectory, frame)
    duration_s = min(path.duration_s, longest_s)
    t = control_times(duration_s)
    profile, wanted = _first_guess(path, t, driver), path.llh(t[2:-2])
    best = Followed(Truth(profile, wanted[0], int(trajectory.t_ns[0])), duration_s, np.inf)
    for _ in range(ROUNDS):
        truth = Truth(profile, wanted[0], int(trajectory.t_ns[0]))
        off = np.linalg.norm(offsets(truth.knots, wanted), axis=1)
        if off.max() >= best.off_m:
            break
        best, worst_s = Followed(truth, duration_s, float(off.max())), float(t[2 + np.argmax(off)])
        profile = steered(profile, truth, wanted, SLACK)
    if best.off_m > WITHIN_M:
        raise EgolocError(
            f"{name}: expected a trajectory that a vehicle can follow within {WITHIN_M:g} m, "
            f"{best.off_m:.1f} m off at {worst_s:.0f} s"
        )
    return best


def offsets(llh: Floats, wanted: Floats) -> Floats:
    """(N, 3) m east, north and up from llh (N, 3) to wanted (N, 3) nearby."""
    lat, h = llh[:, 0], llh[:, 2]
    metres = np.stack(((transverse_radius(lat) + h) * np.cos(lat), meridian_radius(lat) + h, np.ones_like(h)), axis=-1)
    return (wanted - llh)[:, [1, 0, 2]] * metres


def steered(
    profile: Profile, truth: Truth, wanted: Floats, slack: tuple[float, float, float], smooth_s: float = 0.0
) -> Profile:
    """The profile of a truth, changed so that its knots (K + 1, 3) come nearer to wanted (K + 1, 3) llh.

    slack: shares of the speed by which it may change along, across and up; smooth_s: length of the mean of the offsets.
    """
    error = offsets(truth.knots, wanted)
    if smooth_s > 0:
        error = uniform_filter1d(error, round(smooth_s / KNOT_S) | 1, axis=0, mode="nearest")
    control = np.stack((profile.speed, profile.yaw, profile.grade, profile.roll), axis=-1)
    _road_kernels.steer(control, error, KNOT_S, np.array(slack))
    speed, yaw, grade, roll = control.T
    return replace(profile, speed=speed, yaw=yaw, grade=grade, roll=roll)


class _Path:
    """Places over time, between the rows of a trajectory and a little beyond."""

    def __init__(self, trajectory: Trajectory, frame: MapFrame) -> None:
        llh = llh_from_map(frame, trajectory.p_map)
        t = seconds(trajectory.t_ns, int(trajectory.t_ns[0]))
        self._plane = Plane(llh[0])
        self._xyz = PchipInterpolator(t, self._plane.xyz(llh))
        self.duration_s = float(t[-1])
        known = np.isfinite(trajectory.q_map_body).all(axis=1)
        self._heading = np.unwrap(yaw_from_q(trajectory.q_map_body[known]))
        self._heading_at = t[known]

    def place(self, t: Floats) -> Floats:
        """(N, 3) m east, north and up of the first row at t (N,) s; beyond the ends the speed there goes on."""
        inside = np.clip(t, 0.0, self.duration_s)
        begin, end = self._xyz(np.array([0.0, KNOT_S])), self._xyz(self.duration_s - np.array([KNOT_S, 0.0]))
        before, after = (begin[1] - begin[0]) / KNOT_S, (end[1] - end[0]) / KNOT_S
        beyond = (t - inside)[:, None]
        result: Floats = self._xyz(inside) + np.where(beyond < 0, beyond * before, beyond * after)
        return result

    def llh(self, t: Floats) -> Floats:
        """(N, 3) llh at t (N,) s."""
        return self._plane.llh(self.place(t))

    def backwards(self, t: Floats, course: Floats) -> NDArray[np.bool_]:
        """(N,) whether the nose points against the course (N,) rad at t (N,) s."""
        if not len(self._heading):
            return np.zeros(len(t), bool)
        heading = np.interp(t, self._heading_at, self._heading)
        result: NDArray[np.bool_] = np.cos(course - heading) < 0
        return result


def _first_guess(path: _Path, t: Floats, driver: Driver) -> Profile:
    """Control points by differences of places half a knot around them."""
    moved = path.place(t + KNOT_S / 2) - path.place(t - KNOT_S / 2)
    level, climb = np.hypot(moved[:, 0], moved[:, 1]) / KNOT_S, moved[:, 2] / KNOT_S
    speed = np.where(level < REST, 0.0, np.hypot(level, climb))
    headed = level >= HEADED
    course = np.arctan2(moved[:, 1], moved[:, 0])
    back = path.backwards(t, course) & headed
    yaw = _held(t, np.where(back, course + np.pi, course), headed, turns=True)
    speed = np.where((np.cos(course - yaw) < 0) & (speed > 0), -speed, speed)
    grade = _held(t, np.arctan2(np.where(back, -climb, climb), level), headed)
    lateral = speed * np.gradient(yaw, KNOT_S)
    return Profile(-MARGIN_S, speed, yaw, grade, np.radians(driver.roll_per_lateral_deg) * lateral)


def _held(t: Floats, values: Floats, known: NDArray[np.bool_], *, turns: bool = False) -> Floats:
    """Values where they are known, interpolated between; turns: angles, unwrapped."""
    if not known.any():
        return np.zeros(len(t))
    given = values[known]
    if turns:
        given = np.concatenate((given[:1], given[0] + np.cumsum(wrap(np.diff(given)))))
    return np.interp(t, t[known], given)
