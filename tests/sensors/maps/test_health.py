"""Map health: each check on the smallest map that has its fault, and on the nearest one that has not."""

from collections import Counter

import numpy as np
import pytest

from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.health import Check, Finding, findings
from sensors.maps.vector_map import Kind, Style, Surfels

ROAD = ([[0.0, 0.0, 1.0], [100.0, 0.0, 1.0]], [[0.0, 7.0, 1.0], [100.0, 7.0, 1.0]])
Things = list[tuple[Kind, list[list[float]]]]


def found(
    *things: tuple[Kind, list[list[float]]], style: Style = Style.SOLID, surfels: Surfels | None = None
) -> list[Finding]:
    """Findings of a straight road with things added (rows 2 and on)."""
    builder = Builder("test")
    for line in ROAD:
        builder.add(Kind.ROAD_BOUNDARY, line, Style.CURB)
    for kind, xyz in things:
        builder.add(kind, xyz, style)
    frame = MapFrame("enu", (49.0, 8.0, 0.0))
    return findings(builder.built(frame) if surfels is None else builder.built(frame, surfels))


def line(*xy: tuple[float, float], z: float = 1.0) -> tuple[Kind, list[list[float]]]:
    return Kind.LANE_LINE, [[x, y, z] for x, y in xy]


def test_a_sound_road_has_no_findings() -> None:
    assert found() == []
    ring = [[50.0, 0.0, 1.0], [53.0, 0.0, 1.0], [53.0, 7.0, 1.0], [50.0, 7.0, 1.0], [50.0, 0.0, 1.0]]
    face = [[60.0, 8.0, 3.0], [60.0, 8.6, 3.0], [60.0, 8.6, 3.6], [60.0, 8.0, 3.6], [60.0, 8.0, 3.0]]
    assert (
        found(
            line((0, 3.5), (30, 3.6), (60, 3.5)),
            line((60, 3.5), (90, 3.5)),
            (Kind.STOP_LINE, [[48.0, 0.1, 1.0], [48.0, 3.4, 1.0]]),
            (Kind.CROSSING, ring),
            (Kind.POLE, [[60.0, 8.0, 1.0], [60.0, 8.0, 4.0]]),
            (Kind.SIGN, face),
            (Kind.SIGN, [[*corner[:2], corner[2] + 0.8] for corner in face]),  # the sign above it
            (Kind.SIGN, [[70.0, 8.0, 3.0]]),
        )
        == []
    )


EIGHT = ((10, 2), (20, 4), (20, 2), (10, 4))
FAULTS: dict[str, tuple[Things, Check, str]] = {
    "zero": ([line((10, 3), (10, 3))], Check.ZERO_LENGTH, "2 vertices within 0.000 m"),
    "repeated": ([line((10, 3), (20, 3), (20, 3), (30, 3))], Check.REPEATED_VERTEX, "vertices 1 and the next"),
    "eight": ([line(*EIGHT)], Check.SELF_INTERSECTION, "at this place first"),
    "back": ([line((10, 3), (20, 3), (12, 3.1))], Check.TURNS_BACK, "by 179 deg"),
    "open": ([(Kind.CROSSING, [[10, 1, 1], [13, 1, 1], [13, 6, 1], [10, 6, 1]])], Check.OPEN_RING, "5.00 m apart"),
    "tiny": ([(Kind.STOP_LINE, [[10, 1, 1], [10, 1.2, 1]])], Check.SIZE, "stop_line 0.20 m long"),
    "tower": ([(Kind.POLE, [[10, 8, 1], [10, 8, 99]])], Check.SIZE, "pole 98.00 m high"),
    "steep": ([(Kind.LANE_LINE, [[10, 3, 1], [12, 3, 1], [13, 3, 1.6], [20, 3, 1.6]])], Check.STEEP, "by +0.60 m"),
    "leaning": ([(Kind.POLE, [[10, 8, 1], [12, 8, 4]])], Check.LEANING, "2.00 m beside it"),
    "sunk": ([(Kind.POLE, [[10, 8, 4], [10, 8, 1]])], Check.LEANING, "top -3.00 m above"),
    "twice": ([line((10, 3), (20, 3)), line((20, 3.01), (10, 3.01))], Check.DUPLICATE, "within 0.05 m"),
    "inside": ([line((10, 3), (40, 3)), line((20, 3.01), (30, 3.01))], Check.COVERED, "within 0.05 m"),
    "away": ([line((10, 30), (40, 30))], Check.OFF_ROAD, "none within 12 m of the lane_line"),
    "lost": ([(Kind.SIGN, [[10, -31, 3]])], Check.OFF_ROAD, "none within 30 m of the sign"),
    "gap": ([line((10, 3), (20, 3)), line((20.2, 3), (40, 3))], Check.GAP, "0.20 m"),
    "step": ([line((10, 3), (20, 3)), line((20, 3), (40, 3), z=1.4)], Check.HEIGHT_STEP, "+0.40 m"),
    "through": ([line((50, 3), (55, -3))], Check.CROSSES_BOUNDARY, "first crossing"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_once_and_nothing_else(name: str) -> None:
    things, check, detail = FAULTS[name]
    (finding,) = found(*things)
    assert finding.check is check
    assert detail in finding.detail
    assert 2 in finding.rows or 3 in finding.rows


def test_a_crossing_is_where_the_line_meets_itself() -> None:
    (finding,) = found(line(*EIGHT))
    assert (finding.x, finding.y) == pytest.approx((15.0, 3.0))


def test_what_is_meant_is_no_fault() -> None:
    assert found(line((10, 3), (20, 3)), line((10, 3.12), (20, 3.12))) == []  # both lines of a double one
    assert found(line((10, 3), (20, 3)), line((10, 3), (20, 3), z=6.0)) == []  # on the bridge above
    assert found(line((10, 3), (20, 3)), line((20.2, 3), (20.2, 6))) == []  # ends that do not go on in each other
    assert found(line(*EIGHT), style=Style.ARROW) == []
    assert found(line((50, 3), (55, -3)), style=Style.VIRTUAL) == []
    assert found(line((10, 3), (20, 3)), line((10, 3), (20, 3)), style=Style.VIRTUAL) == []


def test_surfels_far_from_every_line_are_one_finding() -> None:
    p = np.array([[50.0, 20.0], [50.0, 500.0], [60.0, 500.0]])
    surfels = Surfels(p, np.ones(3), np.tile((0.0, 0.0, 1.0), (3, 1)), np.full((3, 2), 0.01))
    (finding,) = found(surfels=surfels)
    assert finding.check is Check.OFF_ROAD
    assert finding.detail.startswith("2 surfels")
    assert (finding.x, finding.y) == (50.0, 500.0)


def test_heights_that_are_not_known_are_no_fault() -> None:
    nan = float("nan")
    things = [(Kind.LANE_LINE, [[10, 3, nan], [20, 3, 1.0]]), (Kind.LANE_LINE, [[20, 3, nan], [30, 3, nan]])]
    assert found(*things) == []


def test_random_maps_do_not_crash_and_findings_do_not_depend_on_the_order() -> None:
    rng = np.random.default_rng(5)
    things: Things = [line((3, 3), (9, 3)), line((9, 3), (3, 3))]
    for _ in range(120):
        count = int(rng.integers(1, 6))
        xyz = np.column_stack((rng.integers(0, 12, (count, 2)), np.ones(count))).astype(float)
        kind = Kind(int(rng.integers(0, 7)))
        things.append((kind if count > 1 else Kind.SIGN, xyz.tolist()))
    one = found(*things)
    assert {Check.DUPLICATE, Check.SELF_INTERSECTION, Check.OPEN_RING} <= {each.check for each in one}
    other = found(*things[::-1])
    last = len(things) + 3
    before = [[row if row < 2 else last - row for row in each.rows] for each in other]
    pairs = Counter((each.check, tuple(sorted(rows))) for each, rows in zip(other, before, strict=True))
    assert pairs == Counter((each.check, tuple(sorted(each.rows))) for each in one)
