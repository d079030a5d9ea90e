"""How the vehicle moved while a frame was taken: points and images are of moments that lie tens of ms apart.

At 10 m/s those are decimetres, at a building ten metres aside some 50 pixels. Everything here is about things that
stand: where one that was seen at some moment lies in the body's axes of another.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors._motion_kernels import carry
from sensors.clock import NS_PER_S
from sensors.frames import Frame, Sweep
from sensors.maps.accumulation import Accumulation, accumulation
from sensors.records import Trajectory
from sensors.vehicle import Vector3

Floats = NDArray[np.float64]


class Motion(Protocol):
    """The vehicle's motion around a frame."""

    def covers(self, first_ns: int, last_ns: int) -> bool:
        """Whether it is known from first_ns to last_ns."""

    def carried(self, p_body: Floats, t_ns: ArrayLike, to_ns: int) -> Floats:
        """(N, 3) m in body axes at to_ns of places (N, 3) in body axes at t_ns (N,) or ()."""


@dataclass(frozen=True)
class Standing:
    """The vehicle does not move, or nothing is known of it."""

    def covers(self, first_ns: int, last_ns: int) -> bool:
        return True

    def carried(self, p_body: Floats, t_ns: ArrayLike, to_ns: int) -> Floats:
        return p_body


@dataclass(frozen=True)
class ConstantVelocity:
    """The vehicle goes on as it does. velocity: m/s and turn_rate: rad/s, both (3,) in body axes."""

    velocity: Vector3
    turn_rate: Vector3 = (0.0, 0.0, 0.0)

    def covers(self, first_ns: int, last_ns: int) -> bool:
        return True

    def carried(self, p_body: Floats, t_ns: ArrayLike, to_ns: int) -> Floats:
        """The exponential of the twist over the time from to_ns to t_ns."""
        p = np.ascontiguousarray(p_body, np.float64)
        dt = np.ascontiguousarray(np.broadcast_to((np.asarray(t_ns, np.int64) - to_ns) / NS_PER_S, len(p)))
        out = np.empty_like(p)
        carry(p, dt, np.array(self.velocity, np.float64), np.array(self.turn_rate, np.float64), out)
        return out


@dataclass(frozen=True)
class AlongTrajectory:
    """The vehicle goes along known poses."""

    poses: Accumulation

    def covers(self, first_ns: int, last_ns: int) -> bool:
        known = self.poses.t_ns
        return bool(
            known[0] <= first_ns and last_ns <= known[-1] and self.poses.widest(first_ns, last_ns) <= self.poses.gap_ns
        )

    def carried(self, p_body: Floats, t_ns: ArrayLike, to_ns: int) -> Floats:
        offset_ns = np.broadcast_to(np.asarray(t_ns, np.int64) - to_ns, (len(p_body),))
        T = self.poses.pose(to_ns)
        return (self.poses.place(p_body, to_ns, offset_ns) - T[:3, 3]) @ T[:3, :3]


def along(trajectory: Trajectory, arm: Vector3 = (0.0, 0.0, 0.0)) -> AlongTrajectory:
    """The motion along a trajectory of a point of the body, arm m. EgolocError as ``accumulation``."""
    return AlongTrajectory(accumulation(trajectory, arm))


def relative(motion: Motion, from_ns: int, to_ns: int) -> Floats:
    """(4, 4) from body axes at from_ns to those at to_ns."""
    at = motion.carried(np.concatenate((np.zeros((1, 3)), np.eye(3))), from_ns, to_ns)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = (at[1:] - at[0]).T, at[0]
    return T


def span_of(frame: Frame) -> tuple[int, int]:
    """The first and the last moment of a frame's stamp, points and images, ns."""
    moments = [frame.t_ns, *(image.t_ns for image in frame.images)]
    for sweep in frame.sweeps:
        if len(sweep) and not sweep.compensated:
            moments += [frame.t_ns + int(sweep.offset_ns.min()), frame.t_ns + int(sweep.offset_ns.max())]
    return min(moments), max(moments)


def points_at(sweep: Sweep, frame_ns: int, motion: Motion, to_ns: int) -> Floats:
    """(N, 3) m a sweep's points in body axes at to_ns. frame_ns: stamp of its frame."""
    moments = frame_ns if sweep.compensated else frame_ns + sweep.offset_ns.astype(np.int64)
    return motion.carried(sweep.in_body(), moments, to_ns)
