"""egoloc map import and export: maps of other formats into ours, and ours into a GIS."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:  # they bring numpy along
    from sensors.geodesy import MapFrame
    from sensors.maps.vector_map import Kind, VectorMap
    from sensors.records import LeftOut

MOST_SHOWN = 12
"""Reasons for leaving things out that are printed; all are in the JSON."""


@dataclass(frozen=True)
class ImportMap:
    """Turn maps of another format into one compact map file.

    Says what it left out and why. Where several maps overlap, each element is taken once.
    """

    format: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FORMAT")]
    """lanelet2, opendrive, argoverse2, geojson, or auto: as the file looks."""
    paths: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SRC... DEST", help_behavior_hint="(required)")
    ]
    """The files (or folders of Argoverse 2 logs) to read, and the map to write; it must not exist yet."""
    frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME", help_behavior_hint="(default: the first source's)")] = (
        None
    )
    """Map frame: utm:32N, utm:32N:EASTING,NORTHING (an origin to subtract, m), enu:LAT,LON,HEIGHT (deg, m), or a map or
    log that has one."""
    rules: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: none)")] = None
    """geojson: kinds for a GIS's own names: [kinds] with lines as "value" = "pole", "property=value" = "stop_line"."""
    tile_m: Annotated[float, tyro.conf.arg(metavar="M")] = 1000.0
    """Side of a tile, m: what is read at once around a pose."""
    overwrite: bool = False
    """Replace DEST."""
    json: bool = False
    """Print what was read as JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Read, write, and say what was read."""
        from replay.map_frames import chosen_frame
        from replay.map_rules import read_rules
        from sensors.maps.joining import joined_maps
        from sensors.maps.store import write_map

        if len(self.paths) < 2:
            raise EgolocError("map import: expected SRC... and DEST, got one path")
        *sources, target = self.paths
        check_new(target, sources, overwrite=self.overwrite)
        format = None if self.format == "auto" else self.format
        rules = None if self.rules is None else read_rules(self.rules)
        with stage("reading") as say:
            maps, left_out = _read(sources, format, chosen_frame(self.frame), rules, say)
            vector_map, repeated = joined_maps(maps)
            if not len(vector_map.elements):
                raise EgolocError(f"{sources[0]}: expected at least one element of a known type, got none")
            say(f"writing {target}")
            write_map(vector_map, target, self.tile_m)
        _report(vector_map, (*left_out, *repeated), target, as_json=self.json)


@dataclass(frozen=True)
class ExportMap:
    """Write a map's elements as GeoJSON, which any GIS shows. Surfels stay behind."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """A map file."""
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST.geojson")]
    """The file to write; it must not exist yet."""
    overwrite: bool = False
    """Replace DEST.geojson."""

    def run(self, _: tuple[str, ...]) -> None:
        """Read and write."""
        from sensors.maps.geojson_out import write_geojson
        from sensors.maps.map_file import open_map

        check_new(self.target, [self.map], overwrite=self.overwrite)
        with stage(f"writing {self.target}"), open_map(self.map) as opened:
            write_geojson(opened.whole(), self.target)
        print(f"GeoJSON: {self.target}")


def check_new(target: Path, sources: list[Path], *, overwrite: bool) -> None:
    """Raise where a file to write exists and may not be replaced, or is one of those to read."""
    if not target.exists():
        return
    if any(source.exists() and target.samefile(source) for source in sources):
        raise EgolocError(f"{target}: expected a file to write, got the source itself")
    if not (overwrite and target.is_file()):
        raise EgolocError(
            f"{target}: exists already: choose another name" + ("" if target.is_dir() else " or add --overwrite")
        )


def _read(
    sources: list[Path],
    format: str | None,
    frame: "MapFrame | None",
    rules: "dict[str, Kind] | None",
    say: Callable[[str], None],
) -> tuple[list["VectorMap"], list["LeftOut"]]:
    """The maps, all in the frame asked for or the first one's."""
    from sensors.maps.formats import read_map

    maps: list[VectorMap] = []
    left_out: list[LeftOut] = []
    for source in sources:
        say(str(source))
        found, missing = read_map(source, format, frame, rules)
        frame = frame or (found.frame if len(sources) > 1 else None)
        maps.append(found)
        left_out += missing
    return maps, left_out


def _report(vector_map: "VectorMap", left_out: tuple["LeftOut", ...], target: Path, *, as_json: bool) -> None:
    import msgspec
    import numpy as np

    from sensors.maps.columns import KINDS
    from sensors.maps.frame_text import text_of

    counts = np.bincount(vector_map.elements.kind, minlength=len(KINDS)).tolist()
    found: dict[str, Any] = {
        "map": str(target),
        "frame": text_of(vector_map.frame),
        "km": vector_map.road_km,
        "elements": {name: count for name, count in zip(KINDS, counts, strict=True) if count},
        "bytes": target.stat().st_size,
        "left_out": [msgspec.to_builtins(row) for row in left_out],
    }
    if as_json:
        print_json(found)
        return
    length = "of unknown length" if vector_map.road_km is None else f"{vector_map.road_km:.3g} km of road"
    print(f"{target}: {length}, {found['bytes'] / 1e3:.1f} kB, frame {found['frame']}")
    print("  " + ", ".join(f"{count:,} {name}" for name, count in found["elements"].items()))
    for row in left_out[:MOST_SHOWN]:
        print(f"  left out: {row.count:,} {row.reason} [{row.source}]")
    if len(left_out) > MOST_SHOWN:
        print(f"  and {len(left_out) - MOST_SHOWN} reasons more: --json names them")
