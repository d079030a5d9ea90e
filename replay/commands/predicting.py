"""egoloc predict: EgoVM along a log."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from replay.commands.map_files import check_new
from replay.commands.output import check_drawings, print_json, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:  # it brings torch along
    from replay.predict import Chosen

MOST_M = 10.0
"""Bodies ride no higher above the ground, m."""
File = tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)")


@dataclass(frozen=True)
class Predict:
    """Match the frames of a log against a vector map, and write the log with the pose fixes that EgoVM finds.

    DEST takes over IMU, GNSS, wheel, reference and tags; pose fixes that LOG had are replaced: `egoloc replay DEST`
    shows what fusion makes of the new ones. A frame that gives none (no landmarks, no pose to begin at) is counted.
    """

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    """An MCAP log with LiDAR frames, images or both, as the weights want them."""
    target: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[DEST.mcap]", help_behavior_hint="(default: none)")
    ] = None
    """The log to write; it must not exist yet. Not needed for pictures."""
    map: Annotated[Path | None, tyro.conf.arg(metavar="MAP", help_behavior_hint="(required)")] = None
    """The vector map, in the map frame of the log."""
    weights: Annotated[str, tyro.conf.arg(metavar="W")] = "small-lidar"
    """small-lidar, or a safetensors file with its config beside it."""
    init: Annotated[str, tyro.conf.arg(metavar="HOW")] = "filter"
    """Where each search begins. filter: where the filter is that has the log's IMU, GNSS and wheel and the fixes so
    far, once the vehicle has moved; reference: the log's reference; reference+NOISE: off it by noise, uniform (2.5 m,
    2.5 deg), uniform-3 (3 m, 3 deg) or gauss (1.5 m along, 0.75 m across, 0.85 deg); /TOPIC: poses of that topic."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the noise."""
    ground_m: Annotated[
        float | None, tyro.conf.arg(metavar="M", help_behavior_hint="(default: as the points show)")
    ] = None
    """Height of the ground under the vehicle in body axes, m: below 0 as a rule."""
    frames: bool = False
    """Put the frames into DEST as well."""
    config: Annotated[Path | None, File] = None
    """A config (TOML) as replay takes it: its [topics], vehicle, map frame and [fusion]."""
    png: Annotated[Path | None, File] = None
    """Draw a match: BEV features, semantic maps, histograms, the map before and after."""
    rrd: Annotated[Path | None, File] = None
    """Write matches as a recording for the rerun viewer."""
    at: Annotated[float, tyro.conf.arg(metavar="S")] = 0.0
    """Where pictures and recordings begin, s after the log's first frame."""
    count: Annotated[int, tyro.conf.arg(metavar="N")] = 10
    """How many matches the recording holds; each takes some 80 MB until it is written."""
    threads: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Of the network. What it finds depends on them in the last digits."""
    overwrite: bool = False
    """Replace DEST."""
    json: bool = False
    """Print what was found as JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Match, write, draw, and say what was found."""
        # as in training: threads that wait for each other on a busy machine take the cores from what they wait for
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        import torch

        from egovm.infer import Matcher
        from egovm.weights import weights_path
        from replay.config import RunConfig, load_config
        from replay.initial_poses import check_init
        from replay.predict import Chosen, Setting, predict
        from sensors.maps.map_file import open_map

        source = self._checked()
        torch.set_num_threads(self.threads)
        check_init(self.init)
        config = RunConfig() if self.config is None else load_config(self.config)
        chosen = Chosen(self.at, self.count if self.rrd else int(self.png is not None))
        with stage(f"matching {self.log}") as say, open_map(source) as vector_map:
            matcher = Matcher(weights_path(self.weights))
            setting = Setting(matcher, vector_map, self.init, self.seed, self.ground_m, config)
            tally = predict(self.log, self.target, setting, chosen, keep_frames=self.frames, say=say)
            self._draw(chosen)
        found = tally.found()
        if self.json:
            print_json({"log": None if self.target is None else str(self.target), **found})
        else:
            self._tell(found)

    def _draw(self, chosen: "Chosen") -> None:
        if self.png is not None:
            from replay.match_picture import draw_match

            draw_match(chosen.seen[0], self.png)
        if self.rrd is not None:
            from replay.match_viewer import write_matches

            write_matches(chosen.seen, self.rrd)

    def _checked(self) -> Path:
        """The map."""
        from egovm.weights import weights_path

        if self.map is None:
            raise EgolocError("predict: expected --map MAP, the vector map to match against")
        if self.target is None and self.png is None and self.rrd is None:
            raise EgolocError("predict: expected DEST.mcap, --png FILE or --rrd FILE")
        if not self.at >= 0.0 or min(self.count, self.threads) < 1 or self.seed < 0:
            raise EgolocError(
                "predict: expected --at and --seed of 0 or more, --count and --threads of 1 or more, got"
                f" {self.at}, {self.seed}, {self.count} and {self.threads}"
            )
        if self.ground_m is not None and not abs(self.ground_m) <= MOST_M:
            raise EgolocError(f"--ground-m: expected metres within {MOST_M:g} of 0, got {self.ground_m:g}")
        given = self.log, self.map, self.config, self.target, weights_path(self.weights)
        check_drawings((self.png, self.rrd), given)
        if self.target is not None:
            check_new(self.target, [self.log, self.map], overwrite=self.overwrite)
        return self.map

    def _tell(self, found: Mapping[str, Any]) -> None:
        """For people."""
        ms = found["ms"]
        took = f", {ms['p50']:.0f} ms each (median; {ms['max']:.0f} at most)" if ms else ""
        print(f"{found['frames']} frames, {found['fixes']} pose fixes{took}")
        for reason, count in found["left_out"].items():
            print(f"  {count} left out: {reason}")
        if found["at_edge"]:
            print(f"  {found['at_edge']} fixes lie at the edge of the search: the truth may lie beyond it")
        for row in found["log_left_out"]:
            print(f"  of the log: {row['source']}: {row['count']} left out: {row['reason']}")
        for name, path in (("Log", self.target), ("Picture", self.png), ("Recording", self.rrd)):
            if path is not None:
                print(f"{name}: {path}")
