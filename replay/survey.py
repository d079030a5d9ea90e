"""Surveying with LiDAR: surfels of clouds or of a drive, and a drive's trajectory refined by its frames.

What the commands ``egoloc map surfels`` and ``egoloc map align`` do; the geometry is in ``sensors.maps``.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from replay.drive import read_reference
from sensors.clouds import read_cloud
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, map_from_llh
from sensors.maps.accumulation import Reach, accumulation
from sensors.maps.alignment import AlignConfig, Alignment, align, listed
from sensors.maps.frame_text import text_of
from sensors.maps.joining import is_same_grid, moved
from sensors.maps.map_file import open_map
from sensors.maps.registration import sampled
from sensors.maps.surfels import SurfelConfig, surfels_in
from sensors.maps.vector_map import VectorMap
from sensors.maps.voxels import Voxels
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_log
from sensors.mcap.topics import CAMERA, LIDAR
from sensors.records import Log, Trajectory
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]
Tell = Callable[[str], None]

ELSEWHERE_M = 100.0
"""A trajectory, or surfels, so far from what they belong to are in another frame."""
SIGHTINGS, APART_S = 3, 1.0
"""What stands still is hit so often, each time this much later, s: a car at 3 m/s is 2 s within a voxel of 1 m."""


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A map with surfels. points, frames: that they come from (frames 0: clouds); sightings: how often a voxel must be
    hit to count, 1: moving things are still in; left_out: what was not used, and why."""

    map: VectorMap
    points: int
    frames: int
    sightings: int
    left_out: Counter[str]


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A log with a trajectory. frame: the map's."""

    path: Path
    trajectory: Trajectory
    frame: MapFrame
    vehicle: Vehicle
    lidar: str | None


def is_log(path: Path) -> bool:
    """Whether a file is a log by its name."""
    return path.suffix.lower() == ".mcap"


def read_drive(
    path: Path, trajectory: Path | None, topics: Mapping[str, str] | None = None, frame: MapFrame | None = None
) -> Drive:
    """A log's reference, or a trajectory file or run instead. frame: the map's, where the log does not say its own.

    Raises EgolocError where there is no trajectory, or no map frame, or the log's is on another grid than frame.
    """
    topics = dict(topics or {})
    lidar = topics.pop(LIDAR, None)
    topics.pop(CAMERA, None)
    log = read_log(path, topics)
    if log.map_frame is not None and frame is not None and not is_same_grid(log.map_frame, frame):
        raise EgolocError(f"{path}: expected map frame {text_of(frame)}, got a log in {text_of(log.map_frame)}")
    frame = log.map_frame or frame
    reference = log.reference
    if trajectory is not None:
        file = trajectory / "smoothed.parquet" if trajectory.is_dir() else trajectory
        if not file.is_file():
            raise EgolocError(f"{file}: no such file: expected a trajectory, or a run made with --smooth")
        reference, frame = read_reference(file, frame, log.vehicle)
        _refuse_elsewhere(file, reference, frame, log)
    if reference is None or not len(reference):
        raise EgolocError(f"{path}: expected a log with a reference trajectory, got none: give --trajectory FILE")
    if frame is None:
        raise EgolocError(f"{path}: expected a log with a map frame, got none: give --frame")
    return Drive(path, reference, frame, log.vehicle, lidar)


def _refuse_elsewhere(file: Path, trajectory: Trajectory, frame: MapFrame | None, log: Log) -> None:
    """Refuse a trajectory that is far from where the log says that it was: most often it is in another frame."""
    known = log.reference
    if known is None and log.gnss is not None and frame is not None:
        known = Trajectory(log.gnss.t_ns, log.gnss.t_ns, map_from_llh(frame, log.gnss.llh))
    if known is None or frame is None or not len(known) or not len(trajectory):
        return
    within = (trajectory.t_ns >= known.t_ns[0]) & (trajectory.t_ns <= known.t_ns[-1])
    if not within.any():
        return
    t_ns, p = trajectory.t_ns[within], trajectory.p_map[within, :2]
    there = np.column_stack([np.interp(t_ns, known.t_ns, known.p_map[:, axis]) for axis in range(2)])
    away = float(np.median(np.hypot(*(p - there).T)))
    if away > ELSEWHERE_M:
        raise EgolocError(
            f"{file}: expected a trajectory in the log's map frame {text_of(frame)}, "
            f"it lies {away:.0f} m (median) from where the log was"
        )


def survey_drive(drive: Drive, config: SurfelConfig, reach: Reach, tell: Tell) -> Survey:
    """Surfels of a drive's frames, of what stands still where the drive is long enough to tell."""
    voxels = Voxels(config.window_m / config.overlap, APART_S)
    try:
        steps = accumulation(drive.trajectory, drive.vehicle.reference_lever_arm, reach)
    except EgolocError as error:
        raise EgolocError(f"{drive.path}: {error}") from None
    points, stamps = 0, []
    for placed in steps.placed(read_frames(drive.path, drive.lidar, images=False)):
        voxels.add(placed.xyz, placed.frame_ns)
        points += len(placed.xyz)
        stamps.append(placed.frame_ns)
        tell(f"{len(stamps)} frames, {points / 1e6:.1f} M points")
    if not stamps:
        raise EgolocError(f"{drive.path}: {_no_frames(steps.left_out)}")
    tell("looking for planes")
    sightings = min(SIGHTINGS, _times_apart(np.array(stamps)))
    found = VectorMap(drive.frame, surfels=surfels_in(voxels, config, sightings), sources=(_source(drive.path),))
    return Survey(_some(found, drive.path), points, len(stamps), sightings, steps.left_out)


def survey_clouds(paths: Sequence[Path], frame: MapFrame | None, config: SurfelConfig, tell: Tell) -> Survey:
    """Surfels of cloud files, one in memory at a time. frame: the map's; None: the first cloud's own."""
    voxels = Voxels(config.window_m / config.overlap)
    left_out: Counter[str] = Counter()
    points = 0
    for path in paths:
        tell(f"{path.name}, {points / 1e6:.1f} M points")
        xyz, frame = _cloud(path, frame, left_out)
        voxels.add(xyz)
        points += len(xyz)
    assert frame is not None
    tell("looking for planes")
    found = VectorMap(frame, surfels=surfels_in(voxels, config), sources=tuple(_source(path) for path in paths))
    return Survey(_some(found, paths[0]), points, 0, 1, left_out)


def added_to(vector_map: VectorMap, survey: Survey) -> Survey:
    """The survey with the elements of a map, whose own surfels are replaced.

    Raises EgolocError where it comes nowhere near them.
    """
    survey = replace(survey, map=moved(survey.map, vector_map.frame))
    away = _between(vector_map.elements.xyz[:, :2], survey.map.surfels.p)
    if away > ELSEWHERE_M:
        name = survey.map.sources[0]
        raise EgolocError(f"{name}: expected surfels near the map's elements, they lie {away / 1e3:.1f} km away")
    sources = (*vector_map.sources, *(name for name in survey.map.sources if name not in vector_map.sources))
    return replace(survey, map=replace(vector_map, surfels=survey.map.surfels, sources=sources))


def align_drive(
    drive: Drive, cloud: Path | None, map: Path | None, config: AlignConfig, reach: Reach, tell: Tell
) -> Alignment:
    """Refine a drive's trajectory by its frames, against a cloud or a map's surfels where there is one."""
    points: Floats | None = None
    left_out: Counter[str] = Counter()
    if cloud is not None:
        points, _ = _cloud(cloud, drive.frame, left_out)
    elif map is not None:
        points = _of_map(map, drive.frame, config)
    arm = drive.vehicle.reference_lever_arm
    frames = read_frames(drive.path, drive.lidar, images=False)
    try:
        found = align(frames, drive.trajectory, points, config, arm, reach, tell)
    except EgolocError as error:
        raise EgolocError(f"{drive.path}: {error}") from None
    found.left_out.update(left_out)
    return found


def map_in(path: Path, frame: MapFrame | None) -> VectorMap:
    """A map file, whole, moved where it only has another origin. Raises EgolocError where it is in another frame."""
    with open_map(path) as opened:
        own = opened.frame
        if frame is None or own == frame:
            return opened.whole()
        if not is_same_grid(own, frame):
            got = f"expected map frame {text_of(frame)}, got a map in {text_of(own)}"
            raise EgolocError(f"{path}: {got}: import it anew with --frame")
        return moved(opened.whole(), frame)


def _of_map(path: Path, frame: MapFrame, config: AlignConfig) -> Floats:
    """(N, 3) points of a map's surfels whose height is known."""
    surfels = map_in(path, frame).surfels
    surfels = surfels.chosen(np.isfinite(surfels.z))
    if not len(surfels):
        raise EgolocError(f"{path}: expected a map with surfels, got none: see egoloc map surfels")
    return sampled(np.column_stack((surfels.p, surfels.z)), surfels.normal, config.registration.voxel_m)


def _cloud(path: Path, frame: MapFrame | None, left_out: Counter[str]) -> tuple[Floats, MapFrame]:
    """Points of a file in a frame, or in its own where none is asked for."""
    cloud = read_cloud(path, frame)
    own = cloud.frame or frame
    if own is None:
        raise EgolocError(f"{path}: does not say where on the earth it lies: give --frame")
    if frame is not None and own != frame:
        raise EgolocError(f"{path}: expected map frame {text_of(frame)}, got a cloud in {text_of(own)}")
    if not len(cloud):
        raise EgolocError(f"{path}: expected points, got none")
    left_out.update({row.reason: row.count for row in cloud.left_out})
    return cloud.xyz, own


def _between(one: Floats, other: Floats) -> float:
    """Metres between the boxes around places (N, 2) and (M, 2); 0 where they meet, or there are none."""
    if not len(one) or not len(other):
        return 0.0
    gap = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
    return float(np.hypot(*np.maximum(gap, 0.0)))


def _some(vector_map: VectorMap, path: Path) -> VectorMap:
    if not len(vector_map.surfels):
        raise EgolocError(f"{path}: expected planes, got no surfel: too few points, or nothing flat")
    return vector_map


def _times_apart(t_ns: NDArray[np.int64]) -> int:
    """How many of rising moments are APART_S or more after the one before of them."""
    count, last = 0, -(2**62)
    for t in t_ns.tolist():
        if t >= last + APART_S * 1e9:
            count, last = count + 1, t
    return count


def _no_frames(left_out: Counter[str]) -> str:
    reasons = f": {listed(left_out)}" if left_out else ""
    return f"expected LiDAR frames along the trajectory, got none that can be used{reasons}"


def _source(path: Path) -> str:
    return f"{path.name} (surfels)"
