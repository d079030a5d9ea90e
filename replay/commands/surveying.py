"""egoloc map surfels and map align: planes for the map, and the reference trajectory by registration."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from replay.commands.map_files import check_new
from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:  # they bring numpy along
    from replay.survey import Drive, Survey
    from sensors.geodesy import MapFrame
    from sensors.maps.alignment import Alignment

MOST_SHOWN = 12
"""Reasons for leaving things out that are printed; all are in the JSON."""

TrajectoryFile = Annotated[
    Path | None, tyro.conf.arg(metavar="FILE|RUN", help_behavior_hint="(default: the log's reference)")
]
MapFile = Annotated[Path | None, tyro.conf.arg(metavar="MAP", help_behavior_hint="(default: none)")]
ConfigFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: none)")]
FrameText = Annotated[str | None, tyro.conf.arg(metavar="FRAME", help_behavior_hint="(default: the source's own)")]
Metres = Annotated[float, tyro.conf.arg(metavar="M")]


@dataclass(frozen=True)
class Surfels:
    """Find surfels, planar patches of the ground, walls and signs, in point clouds or in the LiDAR frames of a log.

    The paper's section 5: planes whose lambda1/lambda2 is at most 0.1, the thinnest one in each cell of the ground.
    Of a log's frames, things that move are left out: what counts was hit in three moments, each a second later.
    """

    paths: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="POINTS... DEST", help_behavior_hint="(required)")
    ]
    """Clouds (LAS, LAZ, PLY, PCD, NPZ, NPY) or one log with LiDAR frames, and the map to write."""
    trajectory: TrajectoryFile = None
    """Poses for a log's frames: what --reference of replay reads, or a run made with --smooth."""
    map: MapFile = None
    """A map whose frame and elements are taken over; its surfels are replaced."""
    frame: FrameText = None
    """Map frame of clouds that name none: utm:32N, utm:32N:EASTING,NORTHING (an origin that was subtracted, m),
    enu:LAT,LON,HEIGHT (deg, m), or a map or log that has one."""
    cell_m: Metres = 1.0
    """Side of a cell of the ground that keeps one surfel, m."""
    max_range_m: Metres = 60.0
    """Points of a frame farther from the LiDAR are not used, m."""
    config: ConfigFile = None
    """A config whose [topics] choose between topics."""
    overwrite: bool = False
    """Replace DEST."""
    json: bool = False
    """Print what was found as JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Read, find, write, and say what was found."""
        from replay.survey import added_to, map_in
        from sensors.maps.store import write_map

        if len(self.paths) < 2:
            raise EgolocError("map surfels: expected POINTS... and DEST, got one path")
        *sources, target = self.paths
        check_new(target, sources, overwrite=self.overwrite)
        frame = _frame(self.frame)
        vector_map = None if self.map is None else map_in(self.map, frame)
        frame = frame if vector_map is None else vector_map.frame
        with stage("surfels") as say:
            survey = self._found(sources, frame, say)
            if vector_map is not None:
                survey = added_to(vector_map, survey)
            say(f"writing {target}")
            write_map(survey.map, target)
        _report_surfels(survey, target, as_json=self.json)

    def _found(self, sources: list[Path], frame: "MapFrame | None", say: Any) -> "Survey":
        from replay.survey import is_log, survey_clouds, survey_drive
        from sensors.maps.surfels import SurfelConfig

        surfels = SurfelConfig(cell_m=_between("--cell-m", self.cell_m, 0.1, 100.0))
        if not any(is_log(path) for path in sources):
            if self.trajectory is not None:
                raise EgolocError(f"--trajectory: expected a log, got the cloud {sources[0]}")
            return survey_clouds(sources, frame, surfels, say)
        if len(sources) > 1:
            raise EgolocError(f"map surfels: expected clouds or one log, got {len(sources)} files with a log")
        return survey_drive(_drive(sources[0], self, frame), surfels, _reach(self.max_range_m), say)


@dataclass(frozen=True)
class Align:
    """Refine a drive's trajectory by its LiDAR frames: register, align, read off poses.

    Frames are registered to each other, where the drive passes a place again as well, and a pose graph weighs that
    against the given trajectory, whose errors average out; with --cloud or --map to what was surveyed before. DEST is
    what replay --reference and map surfels --trajectory read.
    """

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    """An MCAP log with LiDAR frames."""
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST.csv")]
    """The trajectory to write; it must not exist yet."""
    trajectory: TrajectoryFile = None
    """The trajectory to refine: what --reference of replay reads, or a run made with --smooth."""
    cloud: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """A point cloud in the log's map frame to align to."""
    map: MapFile = None
    """A map with surfels to align to."""
    frame: FrameText = None
    """Map frame of a log that names none."""
    sigma_m: Metres = 0.5
    """Standard deviation of the trajectory's positions where it does not say, m."""
    sigma_yaw_deg: Annotated[float, tyro.conf.arg(metavar="DEG")] = 0.5
    """Standard deviation of its yaw where it does not say, deg."""
    correlation_s: Annotated[float, tyro.conf.arg(metavar="S")] = 30.0
    """Over which its errors are forgotten, s."""
    keyframe_m: Metres = 1.5
    """Frames are used that lie this far apart, m."""
    max_range_m: Metres = 60.0
    """Points of a frame farther from the LiDAR are not used, m."""
    config: ConfigFile = None
    """A config whose [topics] choose between topics."""
    overwrite: bool = False
    """Replace DEST.csv."""
    json: bool = False
    """Print what was found as JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Read, align, write, and say what changed."""
        from replay.survey import align_drive
        from sensors.datasets.trajectory_csv import write_trajectory

        given = [path for path in (self.log, self.trajectory, self.cloud, self.map) if path is not None]
        check_new(self.target, given, overwrite=self.overwrite)
        if self.cloud is not None and self.map is not None:
            raise EgolocError("map align: expected --cloud or --map, got both")
        config, reach = self._config(), _reach(self.max_range_m)
        with stage(f"aligning {self.log}") as say:
            drive = _drive(self.log, self, _frame(self.frame))
            found = align_drive(drive, self.cloud, self.map, config, reach, say)
            write_trajectory(found.trajectory, self.target)
        _report_alignment(found, drive, self.target, as_json=self.json)

    def _config(self) -> Any:
        from sensors.maps.alignment import AlignConfig
        from sensors.maps.corrections import ErrorModel

        errors = ErrorModel(
            sigma_m=_between("--sigma-m", self.sigma_m, 0.001, 100.0),
            sigma_yaw_deg=_between("--sigma-yaw-deg", self.sigma_yaw_deg, 0.001, 30.0),
            correlation_s=_between("--correlation-s", self.correlation_s, 0.1, 1e5),
        )
        return AlignConfig(errors=errors, keyframe_m=_between("--keyframe-m", self.keyframe_m, 0.01, 100.0))


def _drive(path: Path, command: Surfels | Align, frame: "MapFrame | None") -> "Drive":
    from replay.config import RunConfig, load_config
    from replay.survey import read_drive

    config = RunConfig() if command.config is None else load_config(command.config)
    return read_drive(path, command.trajectory, config.topics, frame or config.map_frame)


def _frame(text: str | None) -> "MapFrame | None":
    from replay.map_frames import chosen_frame

    return chosen_frame(text)


def _reach(max_range_m: float) -> Any:
    from sensors.maps.accumulation import Reach

    return Reach(max_range_m=_between("--max-range-m", max_range_m, 5.0, 500.0))


def _between(name: str, value: float, least: float, most: float) -> float:
    if not least <= value <= most:
        raise EgolocError(f"{name}: expected {least:g}..{most:g}, got {value:g}")
    return value


def _report_surfels(survey: "Survey", target: Path, *, as_json: bool) -> None:
    from sensors.maps.frame_text import text_of

    km, count = survey.map.road_km, len(survey.map.surfels)
    found: dict[str, Any] = {
        "map": str(target),
        "frame": text_of(survey.map.frame),
        "surfels": count,
        "surfels_per_km": count / km if km else None,
        "elements": len(survey.map.elements),
        "points": survey.points,
        "frames": survey.frames,
        "sightings": survey.sightings,
        "bytes": target.stat().st_size,
        "left_out": dict(survey.left_out.most_common()),
    }
    if as_json:
        print_json(found)
        return
    per_km = f" ({found['surfels_per_km']:,.0f} per km of road)" if km else ""
    origin = f"{survey.frames} frames, " if survey.frames else ""
    print(f"{target}: {count:,} surfels{per_km} of {origin}{survey.points / 1e6:.2f} M points")
    print(f"  {found['elements']:,} elements, {found['bytes'] / 1e3:.1f} kB, frame {found['frame']}")
    if survey.frames and survey.sightings == 1:
        print("  the frames are too close in time to tell what moves: it is still in")
    _print_left_out(survey.left_out)


def _report_alignment(found: "Alignment", drive: "Drive", target: Path, *, as_json: bool) -> None:
    import numpy as np

    from sensors.maps.frame_text import text_of

    sigma = np.median(found.trajectory.sigma, axis=0)
    told: dict[str, Any] = {
        "trajectory": str(target),
        "frame": text_of(drive.frame),
        "rows": len(found.trajectory),
        "frames": found.frames,
        "registered": found.registered,
        "loops": found.loops,
        "contradicted": found.weighed_down,
        "inliers": found.inliers,
        "rms_m": found.rms_m,
        "correction_m": {"mean": float(found.correction_m.mean()), "max": float(found.correction_m.max())},
        "correction_yaw_deg": {
            "mean": float(np.degrees(np.abs(found.correction_yaw)).mean()),
            "max": float(np.degrees(np.abs(found.correction_yaw)).max()),
        },
        "sigma_m": float(sigma[0]),
        "sigma_yaw_deg": float(np.degrees(sigma[1])),
        "left_out": dict(found.left_out.most_common()),
    }
    if as_json:
        print_json(told)
        return
    place, yaw = told["correction_m"], told["correction_yaw_deg"]
    print(f"{target}: {told['rows']:,} poses, refined by {found.frames} frames, frame {told['frame']}")
    print(f"  corrected by {place['mean']:.3f} m (at most {place['max']:.3f}), ", end="")
    print(f"yaw by {yaw['mean']:.3f} deg (at most {yaw['max']:.3f})")
    print(f"  known to {told['sigma_m']:.3f} m, {told['sigma_yaw_deg']:.3f} deg (median, one sigma)")
    print(
        f"  {found.registered} registrations, {found.loops} of them loops, {found.weighed_down} contradicted by others;"
    )
    print(f"  {100 * found.inliers:.0f} % of the points fit, to {100 * found.rms_m:.1f} cm (medians)")
    _print_left_out(found.left_out)


def _print_left_out(left_out: "Counter[str]") -> None:
    for reason, count in left_out.most_common(MOST_SHOWN):
        print(f"  left out: {count:,} {reason}")
    if len(left_out) > MOST_SHOWN:
        print(f"  and {len(left_out) - MOST_SHOWN} reasons more: --json names them")
