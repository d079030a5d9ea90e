"""A street of boxes on a plane, seen by a spinning LiDAR on a moving car: rays cast with numpy, for small tests."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.frames import Frame, Sweep
from sensors.records import Trajectory
from sensors.rotation import q_from_rpy, rotate

Floats = NDArray[np.float64]

T0 = 1_700_000_000_000_000_000
TURN_NS = 100_000_000
NOISE_M = 0.02
MOUNT = np.array([0.8, 0.0, 1.8])
"""Of the LiDAR on the body, m; the body's origin is 0.4 m above the ground."""
GROUND_M = -0.4
ELEVATIONS = np.radians(np.linspace(-24.0, 12.0, 28))
AZIMUTHS = 360
MOST_M = 70.0


@dataclass(frozen=True)
class Street:
    """boxes: (B, 2, 3) corners m in the street's axes; yaw: of its axes in the map, rad."""

    boxes: Floats
    yaw: float = 0.3

    def in_map(self, xyz: Floats) -> Floats:
        """(N, 3) street to map."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return xyz @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def in_street(self, xyz: Floats) -> Floats:
        """(N, 3) map to street."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return xyz @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def block(seed: int, length: float = 60.0, width: float = 40.0) -> Street:
    """Houses on both sides of a road around a block, and poles; the road's middle line is a rectangle about 0, 0."""
    rng = np.random.default_rng(seed)
    boxes = []
    for sign, away in ((1, 7.0), (-1, 8.0)):
        for axis, half, across in ((0, length / 2, width / 2), (1, width / 2, length / 2)):
            reach = half + (away if sign > 0 else -away)
            for side in (1, -1):
                at = -reach
                while at < reach - 4.0:
                    size = rng.uniform(5.0, 12.0)
                    back = side * (across + sign * (away + rng.uniform(0.0, 2.0)))
                    depth = side * sign * 6.0
                    low, high = np.array([at, min(back, back + depth)]), np.array([at + size, max(back, back + depth)])
                    height = rng.uniform(4.0, 9.0)
                    order = [0, 1] if axis == 0 else [1, 0]
                    boxes.append([[*low[order], GROUND_M], [*high[order], height]])
                    at += size + rng.uniform(1.0, 5.0)
                for _ in range(4):
                    spot = np.array([rng.uniform(-reach, reach), side * (across + sign * rng.uniform(4.5, 6.0))])
                    x, y = spot[[0, 1] if axis == 0 else [1, 0]]
                    boxes.append([[x - 0.1, y - 0.1, GROUND_M], [x + 0.1, y + 0.1, 6.0]])
    return Street(np.array(boxes))


def around(street: Street, laps: float, speed: float = 8.0, length: float = 60.0, width: float = 40.0) -> Trajectory:
    """The true trajectory along the rectangle with rounded corners, 50 Hz."""
    radius = 6.0
    straight = np.array([length - 2 * radius, width - 2 * radius] * 2)
    lap = straight.sum() + 2 * np.pi * radius
    s = np.arange(0.0, laps * lap, speed / 50.0)
    x, y, yaw = _rectangle(s % lap, straight, radius, length, width)
    yaw = np.unwrap(yaw + 2 * np.pi * (s // lap)) + street.yaw
    p = street.in_map(np.column_stack((x, y, np.zeros(len(s)))))
    t = T0 + np.arange(len(s)) * 20_000_000
    wobble = 0.005 * np.sin(s / 7.0)
    return Trajectory(t, t, p, q_from_rpy(wobble, 0.5 * wobble, yaw))


def _rectangle(
    s: Floats, straight: Floats, radius: float, length: float, width: float
) -> tuple[Floats, Floats, Floats]:
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (np.array([length, width]) / 2 - radius)
    x, y, yaw = np.zeros_like(s), np.zeros_like(s), np.zeros_like(s)
    begin = 0.0
    for k in range(4):
        heading = k * np.pi / 2
        d, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        on = (s >= begin) & (s < begin + straight[k])
        start = corner[k] - radius * left
        x[on], y[on] = (start[:, None] + d[:, None] * (s[on] - begin)) if on.any() else ([], [])
        yaw[on] = heading
        begin += straight[k]
        arc = radius * np.pi / 2
        on = (s >= begin) & (s < begin + arc)
        angle = (s[on] - begin) / radius
        middle = corner[(k + 1) % 4]
        x[on] = middle[0] + radius * np.sin(heading + angle)
        y[on] = middle[1] - radius * np.cos(heading + angle)
        yaw[on] = heading + angle
        begin += arc
    return x, y, yaw


def frames(
    street: Street,
    truth: Trajectory,
    every_ns: int = 200_000_000,
    seed: int = 0,
    moving: Callable[[float], Floats] | None = None,
    azimuths: int = AZIMUTHS,
) -> Iterator[Frame]:
    """What the LiDAR sees, one turn of 0.1 s after each stamp. moving: boxes (M, 2, 3) at s after the start."""
    rng = np.random.default_rng(seed)
    azimuth = np.repeat(np.linspace(0.0, 2 * np.pi, azimuths, endpoint=False), len(ELEVATIONS))
    elevation = np.tile(ELEVATIONS, azimuths)
    offset = (azimuth / (2 * np.pi) * TURN_NS).astype(np.int32)
    ray = np.column_stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
    from scipy.spatial.transform import Rotation, Slerp

    turn = Slerp(truth.t_ns - T0, Rotation.from_quat(truth.q_map_body))
    for t in range(int(truth.t_ns[0]), int(truth.t_ns[-1]) - TURN_NS, every_ns):
        when = t + offset.astype(np.int64)
        p = np.column_stack([np.interp(when - T0, truth.t_ns - T0, truth.p_map[:, i]) for i in range(3)])
        q = turn(when - T0).as_quat()
        boxes = street.boxes if moving is None else np.concatenate((street.boxes, moving((t - T0) * 1e-9)))
        distance = cast(boxes, street.in_street(p + rotate(q, MOUNT)), street.in_street(rotate(q, ray)))
        hit = distance < MOST_M
        distance = distance[hit] + rng.normal(0.0, NOISE_M, hit.sum())
        T = np.eye(4)
        T[:3, 3] = MOUNT
        yield Frame(t, t, (Sweep((ray[hit] * distance[:, None]).astype(np.float32), T, offset[hit]),))


def cast(boxes: Floats, origin: Floats, ray: Floats) -> Floats:
    """(N,) m along each ray to the ground or the nearest box; inf: nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (GROUND_M - origin[:, 2]) / ray[:, 2]
        nearest = np.where(ground > 0.0, ground, np.inf)
        inverse = 1.0 / ray
        middle = origin.mean(axis=0)
        for low, high in boxes:
            if np.linalg.norm(np.clip(middle, low, high) - middle) > MOST_M:
                continue
            a, b = (low - origin) * inverse, (high - origin) * inverse
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            inside = (enter <= leave) & (enter > 0.0)
            nearest = np.where(inside & (enter < nearest), enter, nearest)
    return nearest
