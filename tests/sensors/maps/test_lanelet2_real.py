"""Real Lanelet2 and Autoware maps against a count of their own, their length and their place."""

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from sensors.geodesy import MapFrame
from sensors.maps.lanelet2 import read
from sensors.maps.placing import LOCAL
from sensors.maps.vector_map import Kind

REAL = ("lanelet2/mapping_example", *(f"autoware/{name}" for name in ("2km_test", "cargo_transport_map")))
REAL_CITY = ("autoware/intersection", "autoware/vm_03_left_hand")


def expected_counts(path: Path) -> Counter[Kind]:
    """Kinds by the tags in the file, counted without the importer."""
    kinds = {
        Kind.ROAD_BOUNDARY: {"road_border", "curbstone", "guard_rail", "wall", "fence"},
        Kind.STOP_LINE: {"stop_line"},
        Kind.SIGN: {"traffic_sign", "traffic_light"},
        Kind.LANE_LINE: {"line_thin", "line_thick", "virtual", "bike_marking"},
        Kind.MARKING: {"pedestrian_marking", "zebra_marking", "zig-zag", "symbol", "keepout", "hatched_road_markings"},
    }
    kind_of = {type: kind for kind, types in kinds.items() for type in types}
    root = ElementTree.parse(path).getroot()
    tags_of = {element: {tag.get("k"): tag.get("v") for tag in element.iter("tag")} for element in root}
    uses: dict[str | None, set[str]] = {}
    for lane in root.iter("relation"):
        if tags_of[lane].get("type") == "lanelet":
            for member in lane.iter("member"):
                side = member.get("role") != "centerline" and tags_of[lane]["subtype"]
                uses.setdefault(member.get("ref"), set()).add(str(side or "centre"))
    found = Counter({Kind.CROSSING: sum(tag.get("subtype") == "crosswalk" for tag in tags_of.values())})
    for line in root.iter("way"):
        type, use = tags_of[line].get("type"), uses.get(line.get("id"), set())
        in_crossing = use == {"crosswalk"} and type in ("pedestrian_marking", "virtual")
        if type in kind_of and use != {"centre"} and not in_crossing and len(line.findall("nd")) > 1:
            found[kind_of[type]] += 1
    return +found


@pytest.mark.parametrize("name", [*REAL, *REAL_CITY])
def test_real_maps_come_in_without_loss_of_a_known_type(data: Path, name: str) -> None:
    path = data / "maps" / f"{name}.osm"
    found, left_out = read(path)
    assert Counter(Kind(kind) for kind in found.elements.kind) == expected_counts(path)
    unknown = [item.reason for item in left_out if "not a known type" in item.reason]
    assert set(unknown) <= {"ways of type intersection_area: not a known type of a thing that is seen"}


def test_the_two_kilometre_map_is_two_kilometres(data: Path) -> None:
    found, _ = read(data / "maps/autoware/2km_test.osm")
    assert found.road_km == pytest.approx(2.0, abs=1e-6)
    assert found.frame == LOCAL


@pytest.mark.parametrize("name", REAL_CITY)
def test_lat_lon_of_autowares_maps_are_their_local_coordinates(data: Path, name: str) -> None:
    """They lie in the MGRS square 54SUE, which begins at 300 km east and 3,900 km north."""
    frame = MapFrame("utm", (300e3, 3900e3, 0.0), 54)
    path = data / "maps" / f"{name}.osm"
    found, _ = read(path, frame)
    locals_ = {
        element.get("id"): {tag.get("k"): tag.get("v") for tag in element.iter("tag")}
        for element in ElementTree.parse(path).getroot().iter("node")
    }
    places = np.array([(float(tag["local_x"] or 0), float(tag["local_y"] or 0)) for tag in locals_.values()])
    nearest = np.abs(found.elements.xyz[::50, None, :2] - places).max(axis=2).min(axis=1)
    assert nearest.max() < 1e-3
