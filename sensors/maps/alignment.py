"""The paper's ground truth: register the frames of a drive, align them to each other or to a cloud, read off poses."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sensors.bounds import Positive
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.maps.accumulation import Reach, accumulation
from sensors.maps.corrections import Corrected, ErrorModel, corrected, pose_sigmas
from sensors.maps.pose_graph import MAP, Edges, Given, Solution, solve
from sensors.maps.registration import Match, RegistrationConfig, Scans, register, scan_of, thinned
from sensors.records import Trajectory
from sensors.vehicle import Vector3

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Tell = Callable[[str], None]

HOPS = (1, 2, 4, 8)
"""A frame is registered to those so many before it."""
AROUND_M = 80.0
"""Of a cloud, what lies within this distance of a frame takes part in its registration, m."""


class AlignConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of the trajectory, and which frames are registered to which."""

    errors: ErrorModel = ErrorModel()
    keyframe_m: Positive = 1.5
    """Frames closer than this to the last one used are left out, m."""
    keyframe_deg: Positive = 10.0
    """Unless they are turned by this, deg."""
    keyframe_s: Positive = 5.0
    """Or come this much later, s."""
    loop_m: Positive = 10.0
    """Frames within this distance, m, are registered to each other too,"""
    loop_s: Positive = 20.0
    """when they are this far apart in time, s."""
    registration: RegistrationConfig = RegistrationConfig()


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A refined trajectory, and how it came about.

    trajectory: at all stamps of the given one from the first frame used to the last, sigma as found; correction_m:
    (N,) horizontal, correction_yaw: (N,) rad; frames: used; registered: registrations believed; loops: of these,
    frames far apart in time; inliers, rms_m: medians over them; weighed_down: that contradict the rest;
    left_out: frames and registrations that were not used, and why.
    """

    trajectory: Trajectory
    correction_m: Floats
    correction_yaw: Floats
    frames: int
    registered: int
    loops: int
    inliers: float
    rms_m: float
    weighed_down: int
    left_out: Counter[str]


class _Found:
    """Registrations as they are made."""

    def __init__(self, left_out: Counter[str]) -> None:
        self.first: list[int] = []
        self.second: list[int] = []
        self.matches: list[Match] = []
        self.loops = 0
        self.left_out = left_out

    def add(self, first: int, second: int, match: Match) -> bool:
        """Take a registration unless it is refused."""
        if match.refused:
            self.left_out[f"registration: {match.refused}"] += 1
            return False
        self.first.append(first)
        self.second.append(second)
        self.matches.append(match)
        return True

    def edges(self) -> Edges:
        T = np.array([match.T for match in self.matches]).reshape(-1, 4, 4)
        cov = np.array([match.cov for match in self.matches]).reshape(-1, 6, 6)
        return Edges(np.array(self.first, np.int64), np.array(self.second, np.int64), T, cov)


def align(
    frames: Iterable[Frame],
    trajectory: Trajectory,
    cloud: Floats | None = None,
    config: AlignConfig | None = None,
    arm: Vector3 = (0.0, 0.0, 0.0),
    reach: Reach | None = None,
    tell: Tell = lambda _: None,
) -> Alignment:
    """Refine the trajectory of a drive by its LiDAR frames.

    cloud: (N, 3) m in the map, that frames are registered to; None: they are registered to each other, and the
    trajectory's own errors average out over the drive. arm: the point of the body whose trajectory it is, m.
    Raises EgolocError where no frame lies within the trajectory, or nothing can be registered.
    """
    config = config or AlignConfig()
    steps = accumulation(trajectory, arm, reach)
    scans = Scans()
    t_ns: list[int] = []
    poses: list[Floats] = []
    near = 0
    for placed in steps.placed(frames):
        if t_ns and not _moved(poses[-1], placed.T_map_body, placed.frame_ns - t_ns[-1], config):
            near += 1
            continue
        tell(f"{len(t_ns) + 1} frames")
        T = placed.T_map_body
        scans.add(thinned((placed.xyz - T[:3, 3]) @ T[:3, :3], config.registration.voxel_m))
        t_ns.append(placed.frame_ns)
        poses.append(T)
    if len(t_ns) < (2 if cloud is None else 1):
        raise EgolocError(_too_few(len(t_ns), near, steps.left_out))
    stamps, T_given = np.array(t_ns, np.int64), np.array(poses)
    found = _Found(steps.left_out)
    if cloud is None:
        _to_each_other(found, scans, stamps, T_given, config, tell)
    else:
        _to_cloud(found, scans, T_given, cloud, config, tell)
    if not found.matches:
        raise EgolocError(f"no frame could be registered: {listed(steps.left_out)}")
    sigma = pose_sigmas(trajectory, stamps, config.errors)
    t_s = (stamps - stamps[0]) * 1e-9
    given = Given(t_s, T_given[:, :3, 3], T_given[:, :3, :3], sigma, config.errors.correlation_s)
    tell("solving")
    solution = solve(given, found.edges())
    return _alignment(corrected(trajectory, stamps, given, solution, arm), found, solution)


def _alignment(refined: Corrected, found: _Found, solution: Solution) -> Alignment:
    left_out = found.left_out
    if refined.outside:
        left_out["rows of the trajectory before the first or after the last frame used"] += refined.outside
    return Alignment(
        trajectory=refined.trajectory,
        correction_m=refined.correction_m,
        correction_yaw=refined.correction_yaw,
        frames=len(solution.p),
        registered=len(found.matches),
        loops=found.loops,
        inliers=float(np.median([match.inliers for match in found.matches])),
        rms_m=float(np.median([match.rms_m for match in found.matches])),
        weighed_down=int((solution.weight < 0.5).sum()),
        left_out=left_out,
    )


def _moved(T_last: Floats, T: Floats, later_ns: int, config: AlignConfig) -> bool:
    """Whether a frame is far enough from the last one used."""
    turned = np.arccos(np.clip((np.trace(T_last[:3, :3].T @ T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return bool(
        np.linalg.norm(T[:3, 3] - T_last[:3, 3]) >= config.keyframe_m
        or turned >= np.radians(config.keyframe_deg)
        or later_ns >= config.keyframe_s * 1e9
    )


def _to_each_other(found: _Found, scans: Scans, t_ns: Nanoseconds, T: Floats, config: AlignConfig, tell: Tell) -> None:
    """Each frame to some before it, and to the nearest that passed long before."""
    tree = KDTree(T[:, :3, 3])
    for second in range(1, len(scans)):
        tell(f"registering {second + 1} of {len(scans)}")
        loop = _long_before(tree, second, t_ns, T, config)
        near = [(second - hop, True) for hop in HOPS if hop <= second]
        for first, sure in [*near, *((number, False) for number in loop)]:
            guess = np.linalg.solve(T[first], T[second])
            match = register(scans[first], scans[second], guess, config.registration, sure=sure)
            found.loops += found.add(first, second, match) and not sure


def _long_before(tree: KDTree, second: int, t_ns: Nanoseconds, T: Floats, config: AlignConfig) -> list[int]:
    """The nearest frame that passed here long before, if any."""
    near = np.array(tree.query_ball_point(T[second, :3, 3], config.loop_m), np.int64)
    near = near[t_ns[near] < t_ns[second] - config.loop_s * 1e9]
    if not len(near):
        return []
    return [int(near[np.argmin(np.linalg.norm(T[near, :3, 3] - T[second, :3, 3], axis=1))])]


def _to_cloud(found: _Found, scans: Scans, T: Floats, cloud: Floats, config: AlignConfig, tell: Tell) -> None:
    """Each frame to the part of the cloud around it, beginning with the correction of the frame before."""
    points = thinned(cloud, config.registration.voxel_m)
    tree = KDTree(points[:, :2])
    middle, part = np.full(3, np.inf), None
    turn, shift = np.eye(3), np.zeros(3)
    for second in range(len(scans)):
        tell(f"registering {second + 1} of {len(scans)}")
        if not np.linalg.norm(T[second, :3, 3] - middle) < AROUND_M / 2:
            middle = T[second, :3, 3]
            part = scan_of(points[tree.query_ball_point(middle[:2], 1.5 * AROUND_M)] - middle)
        assert part is not None
        guess = T[second].copy()
        guess[:3, :3] = turn @ guess[:3, :3]
        guess[:3, 3] += shift - middle
        match = register(part, scans[second], guess, config.registration)
        match.T[:3, 3] += middle
        if found.add(MAP, second, match):
            turn, shift = match.T[:3, :3] @ T[second, :3, :3].T, match.T[:3, 3] - T[second, :3, 3]


def _too_few(count: int, near: int, left_out: Counter[str]) -> str:
    close = f", {near} more too near to it" if near else ""
    reasons = f": {listed(left_out)}" if left_out else ""
    return f"expected frames with LiDAR points along the trajectory, got {count} that can be used{close}{reasons}"


def listed(left_out: Counter[str]) -> str:
    """Reasons with their counts, the most frequent first."""
    return ", ".join(f"{count} {reason}" for reason, count in left_out.most_common())
