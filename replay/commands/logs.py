"""egoloc convert, simulate and info: making logs and looking into them."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:  # records bring numpy along
    from sensors.records import Frame, Log


@dataclass(frozen=True)
class Convert:
    """Turn a recorded drive of another format into an MCAP log with ROS 2 messages."""

    format: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FORMAT")]
    """rtklib, imu-gnss-drive, comma2k19, novatel, rosbag, gtsam-kitti, argoverse2 or nuscenes-frame."""
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SRC")]
    """The file or folder to read."""
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST.mcap")]
    """The log to write; it must not exist yet."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: what SRC holds)")] = (
        None
    )
    """A trajectory that becomes the log's reference: TUM, CSV with named columns, or Applanix."""
    overwrite: bool = False
    """Replace DEST.mcap."""
    json: bool = False
    """Print what was read as JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Read, write, and say what was read."""
        from sensors.datasets import frames, load

        _check_new(self.log, overwrite=self.overwrite)
        if self.log.exists() and self.source.exists() and self.log.samefile(self.source):
            raise EgolocError(f"{self.log}: expected a log to write, got the source itself")
        with stage(f"reading {self.source}"):
            log = load(self.format, self.source)
            if self.reference is not None:
                from replay.harness import with_reference

                log = with_reference(log, self.reference, log.map_frame)
        _write((log,), self.log, "writing", as_json=self.json, frames=frames(self.format, self.source))


@dataclass(frozen=True)
class Simulate:
    """Write a simulated drive as an MCAP log."""

    scenario: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENARIO")]
    """A scenario of the package (demo, clean, road-test, static, survey) or a TOML file with one."""
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST.mcap")]
    """The log to write; it must not exist yet."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: the scenario's)")] = None
    """Seed of everything random."""
    duration_s: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="(default: the scenario's)")] = (
        None
    )
    """Length of the drive, s."""
    length_km: Annotated[float | None, tyro.conf.arg(metavar="KM", help_behavior_hint="(default: the scenario's)")] = (
        None
    )
    """Length of the drive, km; with a duration as well, what ends first."""
    frames: bool = False
    """Put LiDAR frames into the log too, 10 a second; SCENARIO must have a [network] (survey has)."""
    map: Annotated[Path | None, tyro.conf.arg(metavar="FILE.parquet", help_behavior_hint="(default: none)")] = None
    """Write the vector map of the streets along the drive as well; SCENARIO must have a [network]."""
    overwrite: bool = False
    """Replace DEST.mcap."""
    json: bool = False
    """Print what was written as JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Simulate, write, and say what was written."""
        from replay.sources import LONGEST_KM, as_long_as
        from sensors.simulate.drive import simulate_pieces
        from sensors.simulate.scenarios import load
        from sensors.simulate.surroundings import drive_frames, drive_map

        for path in (self.log,) if self.map is None else (self.log, self.map):
            _check_new(path, overwrite=self.overwrite)
        if self.map is not None and self.map.resolve() == self.log.resolve():
            raise EgolocError(f"--map: expected another file than the log, got {self.map}")
        if self.length_km is not None and not 0 < self.length_km <= LONGEST_KM:
            raise EgolocError(f"--length-km: expected more than 0 and at most {LONGEST_KM:g}, got {self.length_km:g}")
        scenario = as_long_as(load(self.scenario), self.length_km, self.duration_s)
        seed = scenario.seed if self.seed is None else self.seed
        drive = scenario.duration_s, seed, scenario
        seen = drive_frames(*drive) if self.frames else ()
        if self.map is not None:
            from sensors.maps.store import write_map

            write_map(drive_map(*drive), self.map)
        _write(simulate_pieces(*drive), self.log, "simulating", as_json=self.json, frames=seen)


@dataclass(frozen=True)
class Info:
    """Say what is in an MCAP log, and what a replay would use of it."""

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    """The log."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: none)")] = None
    """A config whose [topics] choose between topics."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Describe the file, then what its sensors yield."""
        from replay.config import RunConfig, load_config
        from replay.inventory import file_inventory, print_inventory

        config = RunConfig() if self.config is None else load_config(self.config)
        with stage(f"reading {self.log}"):
            found = file_inventory(self.log, config.topics)
        if self.json:
            print_json(found)
        else:
            print_inventory(found)


def _write(pieces: "Iterable[Log]", path: Path, doing: str, *, as_json: bool, frames: "Iterable[Frame]" = ()) -> None:
    """Write the pieces and the frames of a drive as they come, and say what it holds."""
    from replay.inventory import Inventory, print_inventory
    from replay.lidar_inventory import FrameCount
    from sensors.mcap.io import write_log

    held, seen = Inventory(), FrameCount()
    with stage(f"{doing} {path}"):
        write_log(path, held.watch(pieces), frames=seen.watch(frames))
    found = held.found(str(path)) | {"frames": seen.found()}
    if as_json:
        print_json(found)
    else:
        print_inventory(found)


def _check_new(path: Path, *, overwrite: bool) -> None:
    if path.exists() and not (overwrite and path.is_file()):
        raise EgolocError(
            f"{path}: exists already: choose another name" + ("" if path.is_dir() else " or add --overwrite")
        )
