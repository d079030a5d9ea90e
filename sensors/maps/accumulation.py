"""LiDAR frames brought into the map by a trajectory: every point by the pose of the moment at which it was measured."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors.bounds import NonNegative, Positive
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.maps._placing_kernels import place_points
from sensors.records import Trajectory
from sensors.rotation import matrix_from_q, rotate
from sensors.vehicle import Vector3

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

GAP_PERIODS = 2.5
GAP_NS = (250_000_000, 1_500_000_000)
"""A pause of the trajectory longer than GAP_PERIODS median periods, within these bounds, is a gap (as in scoring)."""


class Reach(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which points of a sweep are used."""

    min_range_m: NonNegative = 1.5
    """Least distance from the LiDAR, m."""
    max_range_m: Positive = 60.0
    """Greatest distance from the LiDAR, m: further off points are sparse, and an error of attitude moves them far."""
    vehicle_min: Vector3 = (-3.0, -1.3, -2.0)
    """Least corner of the box around the vehicle itself, whose points are left out, m, body axes."""
    vehicle_max: Vector3 = (4.5, 1.3, 2.2)
    """Its greatest corner."""


class Placed(NamedTuple):
    """Points of one frame. xyz: (N, 3) m in the map; frame_ns: the frame's t_ns; T_map_body: (4, 4) at that moment."""

    frame_ns: int
    xyz: Floats
    T_map_body: Floats


@dataclass(slots=True, eq=False)
class Accumulation:
    """Frames on a trajectory of the body's origin, from ``accumulation``; left_out counts what was not used."""

    t_ns: Nanoseconds
    p: Floats
    R: Floats
    turn: Floats
    gap_ns: float
    reach: Reach
    left_out: Counter[str] = field(default_factory=Counter)

    def placed(self, frames: Iterable[Frame]) -> Iterator[Placed]:
        """The frames within the trajectory, as they come; a frame without points within reach is left out too."""
        for frame in frames:
            reason = self._why_not(frame)
            if reason is None:
                xyz = self._in_map(frame)
                if len(xyz):
                    yield Placed(frame.t_ns, xyz, self.pose(frame.t_ns))
                    continue
                reason = "no points within reach"
            self.left_out[reason] += 1

    def pose(self, t_ns: int) -> Floats:
        """(4, 4) T_map_body at one moment."""
        corners = np.concatenate((np.zeros((1, 3)), np.eye(3)))
        at = self.place(corners, t_ns, np.zeros(4, np.int32))
        T = np.eye(4)
        T[:3, 3] = at[0]
        T[:3, :3] = (at[1:] - at[0]).T
        return T

    def _why_not(self, frame: Frame) -> str | None:
        """Why no pose is known throughout a frame; None: it is."""
        offsets = [sweep.offset_ns for sweep in frame.sweeps if len(sweep) and not sweep.compensated]
        first = frame.t_ns + min((int(offset.min()) for offset in offsets), default=0)
        last = frame.t_ns + max((int(offset.max()) for offset in offsets), default=0)
        if min(first, frame.t_ns) < self.t_ns[0] or max(last, frame.t_ns) > self.t_ns[-1]:
            return "outside of the trajectory"
        widest = self.widest(min(first, frame.t_ns), max(last, frame.t_ns))
        return "in a gap of the trajectory" if widest > self.gap_ns else None

    def widest(self, first_ns: int, last_ns: int) -> int:
        """The longest pause of the trajectory from first_ns to last_ns, ns."""
        left = max(int(np.searchsorted(self.t_ns, first_ns, side="right")) - 1, 0)
        right = int(np.searchsorted(self.t_ns, last_ns, side="left"))
        return int(np.diff(self.t_ns[left : right + 1]).max(initial=0))

    def _in_map(self, frame: Frame) -> Floats:
        parts = []
        for sweep in frame.sweeps:
            distance = np.linalg.norm(sweep.xyz.astype(np.float64), axis=1)
            body = sweep.in_body()
            own = ((body >= self.reach.vehicle_min) & (body <= self.reach.vehicle_max)).all(axis=1)
            near = (distance >= self.reach.min_range_m) & (distance <= self.reach.max_range_m) & ~own
            offset = sweep.offset_ns[near] * np.int32(not sweep.compensated)
            parts.append(self.place(body[near], frame.t_ns, offset))
        return np.concatenate(parts) if parts else np.empty((0, 3))

    def place(self, body: Floats, t_ns: int, offset_ns: NDArray[Any]) -> Floats:
        """(N, 3) m in the map of places (N, 3) in body axes, each at t_ns + offset_ns (N,)."""
        out = np.empty((len(body), 3))
        place_points(np.ascontiguousarray(body), t_ns, offset_ns, self.t_ns, self.p, self.R, self.turn, out)
        return out


def accumulation(trajectory: Trajectory, arm: Vector3 = (0.0, 0.0, 0.0), reach: Reach | None = None) -> Accumulation:
    """Prepare to place frames. arm: the point of the body whose trajectory it is, m.

    Places between two rows are linear: 10 Hz leaves 1 mm in a turn of 1 m/s^2, 4 Hz 8 mm. Rows without attitude are
    not used. Raises EgolocError where fewer than two are left.
    """
    known = np.isfinite(trajectory.q_map_body).all(axis=1)
    if known.sum() < 2:
        raise EgolocError(
            f"trajectory: expected two or more poses with attitude, got {known.sum()} of {len(trajectory)} rows"
        )
    rows = trajectory[known]
    p = rows.p_map - rotate(rows.q_map_body, np.asarray(arm, np.float64))
    R = matrix_from_q(rows.q_map_body)
    vector = Rotation.from_matrix(R[:-1].transpose(0, 2, 1) @ R[1:]).as_rotvec()
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    axis = np.divide(vector, angle, out=np.zeros_like(vector), where=angle > 0.0)
    turn = np.hstack((axis, angle))
    return Accumulation(rows.t_ns, np.ascontiguousarray(p), R, turn, _gap_ns(rows.t_ns), reach or Reach())


def _gap_ns(t_ns: Nanoseconds) -> float:
    """The pause above which poses are not interpolated, ns."""
    return float(np.clip(GAP_PERIODS * float(np.median(np.diff(t_ns))), *GAP_NS))
