"""egoloc map check."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from replay.commands.output import print_json, stage

if TYPE_CHECKING:  # both bring numpy along
    from sensors.maps.health import Finding
    from sensors.maps.vector_map import VectorMap


@dataclass(frozen=True)
class CheckMap:
    """List what in a map's geometry and topology cannot be, or is hardly meant: lines that cross themselves, have no
    length, lie on each other, or are off the road; gaps, and heights that jump.

    Exit code 1 where there are errors; notices are worth a look.
    """

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """A map file."""
    most: Annotated[int, tyro.conf.arg(metavar="N")] = 5
    """Findings of each check that are listed; the JSON has all."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> int:
        """Check, list, and return the exit code."""
        from sensors.maps.health import findings
        from sensors.maps.map_file import open_map

        with stage(f"checking {self.map}"), open_map(self.map) as opened:
            vector_map = opened.whole()
            found = findings(vector_map)
        errors = sum(each.is_error for each in found)
        if self.json:
            print_json({"map": str(self.map), "errors": errors, "findings": [_entry(vector_map, f) for f in found]})
        else:
            print("\n".join(_lines(vector_map, found, self.most)))
            print(
                f"{self.map}: {errors} errors, {len(found) - errors} notices in {len(vector_map.elements):,} elements"
            )
        return 1 if errors else 0


def _entry(vector_map: "VectorMap", finding: "Finding") -> dict[str, Any]:
    from sensors.maps.columns import KINDS

    elements = vector_map.elements
    return {
        "check": finding.check.name.lower(),
        "error": finding.is_error,
        "elements": [
            {
                "name": str(elements.name[row]),
                "kind": KINDS[elements.kind[row]],
                "source": vector_map.sources[elements.source[row]],
            }
            for row in finding.rows
        ],
        "x": round(finding.x, 3),
        "y": round(finding.y, 3),
        "detail": finding.detail,
    }


def _lines(vector_map: "VectorMap", found: list["Finding"], most: int) -> Iterator[str]:
    """Check by check: how often, what it means, and the first few."""
    from sensors.maps.health import Check

    for check in Check:
        mine = [each for each in found if each.check is check]
        if not mine:
            continue
        yield f"{'ERROR ' if mine[0].is_error else 'notice'} {len(mine):,} x {check.name.lower()}: {check.value}"
        for entry in (_entry(vector_map, each) for each in mine[:most]):
            names = " and ".join(f"{element['name']} ({element['kind']})" for element in entry["elements"])
            yield f"         {names or 'surfels'} at {entry['x']:.2f}, {entry['y']:.2f}: {entry['detail']}"
        if len(mine) > most:
            yield f"         and {len(mine) - most:,} more"
