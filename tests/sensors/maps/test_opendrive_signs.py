"""Signals and objects of OpenDRIVE roads, placed by hand."""

from pathlib import Path

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.maps.vector_map import Elements, Kind, Style
from tests.sensors.maps.xodr import ARC, WIDTH, imported, road, section

LANES = section(
    "<left>" + "".join(f'<lane id="{row}" type="driving">{WIDTH}</lane>' for row in (1, 2)) + "</left>"
    f'<right><lane id="-1" type="driving">{WIDTH}</lane><lane id="-2" type="sidewalk">{WIDTH}</lane></right>'
)


def _signal(attributes: str, inner: str = "") -> str:
    return f"<signals><signal {attributes}>{inner}</signal></signals>"


def _object(attributes: str, inner: str = "") -> str:
    return f"<objects><object id='7' {attributes}>{inner}</object></objects>"


def _taken(folder: Path, more: str, attributes: str = 'id="1" junction="-1"') -> tuple[Elements, dict[str, int]]:
    """What the signals and objects alone give."""
    vector_map, left_out = imported(folder, road(LANES, more=more, attributes=attributes))
    mine = [row for row, name in enumerate(vector_map.elements.name) if "signal" in name or "object" in name]
    return vector_map.elements.chosen(np.array(mine, int)), left_out


@pytest.mark.parametrize(
    ("attributes", "inner", "rule", "ends"),
    [
        ('t="0" orientation="-" width="3.75"', "", "RHT", [7.0, 0.0]),
        ('t="0" orientation="+"', "", "RHT", [0.0, -3.5]),
        ('t="0" orientation="-"', "", "LHT", [0.0, -3.5]),
        ('t="0" orientation="none"', "", "RHT", [7.0, -3.5]),
        ('t="0" orientation="-"', '<validity fromLane="2" toLane="2"/>', "RHT", [7.0, 3.5]),
        ('t="5.25" orientation="-" width="3"', "", "RHT", [6.75, 3.75]),
    ],
)
def test_a_stop_line_lies_across_its_lanes(
    tmp_path: Path, attributes: str, inner: str, rule: str, ends: list[float]
) -> None:
    signal = _signal(f's="4" id="3" type="294" country="OpenDRIVE" {attributes}', inner)
    lines, _ = _taken(tmp_path, signal, f'id="1" junction="-1" rule="{rule}"')
    assert (lines.kind[0], lines.name[0]) == (Kind.STOP_LINE, "road 1 signal 3")
    np.testing.assert_allclose(lines.vertices(0), [[4, ends[0], 0], [4, ends[1], 0]], atol=1e-9)


def test_a_sign_has_a_face_and_a_standing_light_a_pole(tmp_path: Path) -> None:
    sign = _signal('s="10" t="-5" id="1" type="206" zOffset="2" height="0.8" width="0.6" hOffset="3.14159265358979"')
    found, _ = _taken(tmp_path, sign)
    assert (found.kind[0], found.style[0]) == (Kind.SIGN, Style.UNKNOWN)
    ring = found.vertices(0)
    np.testing.assert_allclose(ring[0], ring[-1])
    np.testing.assert_allclose(ring.min(axis=0), [10, -5.3, 2.0], atol=1e-9)
    np.testing.assert_allclose(ring.max(axis=0), [10, -4.7, 2.8], atol=1e-9)
    light, _ = _taken(tmp_path, _signal('s="10" t="-5" id="1" type="1000001" dynamic="yes" height="3.2" width="0.4"'))
    assert light.kind.tolist() == [Kind.POLE, Kind.SIGN]
    assert light.style[1] == Style.LIGHT
    np.testing.assert_allclose(light.xyz, [[10, -5, 0], [10, -5, 3.2], [10, -5, 3.2]], atol=1e-9)


def test_a_signal_may_stand_elsewhere(tmp_path: Path) -> None:
    inertial = '<positionInertial x="1" y="2" z="3" hdg="0"/>'
    found, _ = _taken(tmp_path, _signal('s="10" t="0" id="1" type="206"', inertial))
    np.testing.assert_allclose(found.vertices(0), [[1, 2, 3]])
    there = _signal('s="10" t="0" id="1" type="206"', '<positionRoad roadId="2" s="25" t="4" zOffset="1"/>')
    other = road(LANES, ARC, attributes='id="2" junction="-1"')
    vector_map, _ = imported(tmp_path, road(LANES, more=there), other)
    place = [46 * np.sin(0.5), 50 - 46 * np.cos(0.5), 1.0]
    row = vector_map.elements.name.tolist().index("road 1 signal 1")
    np.testing.assert_allclose(vector_map.elements.vertices(row), [place], atol=1e-9)
    with pytest.raises(EgolocError, match=r"line \d+: <positionRoad>: roadId: expected a road of this file, got '2'"):
        imported(tmp_path, road(LANES, more=there))


def test_crossings_and_arrows_drawn_as_signals(tmp_path: Path) -> None:
    crossing = 's="20" t="0" id="1" type="1000003" country="OpenDRIVE" width="10" value="4" hOffset="0"'
    found, _ = _taken(tmp_path, _signal(crossing))
    ring = [[22, 5, 0], [22, -5, 0], [18, -5, 0], [18, 5, 0], [22, 5, 0]]
    assert found.kind.tolist() == [Kind.CROSSING]
    np.testing.assert_allclose(found.vertices(0), ring, atol=1e-9)
    found, left_out = _taken(tmp_path, _signal('s="2" t="-1.5" id="1" type="-1" name="SgRMArrowLeft.flt" width="0.7"'))
    assert (found.kind.tolist(), found.style.tolist()) == ([Kind.MARKING], [Style.ARROW])
    assert not [reason for reason in left_out if "signal" in reason]


def test_what_is_not_taken_is_counted(tmp_path: Path) -> None:
    unknown = '<signal s="1" t="0" id="1" type="-1" name="thing"/><signal s="200" t="0" id="2" type="206"/>'
    flat = '<signal s="1" t="0" id="3" type="1000003" country="OpenDRIVE"/><signalReference s="1" t="0" id="9"/>'
    objects = "".join(
        f'<object id="{row}" type="{kind}" s="1" t="1"/>' for row, kind in enumerate(("tree", "tree", "car"))
    )
    more = f"<signals>{unknown}{flat}</signals><objects>{objects}<tunnel s='0' length='5'/></objects>"
    taken, left_out = _taken(tmp_path, more)
    assert len(taken) == 0
    expected = {
        "signals of unknown type": 1,
        "signals beyond the end of their road": 1,
        "crossings without a size": 1,
        "references to signals of other roads: the signal is taken once, where it stands": 1,
        "objects of type tree: the map has no such kind": 2,
        "objects of type car: the map has no such kind": 1,
        "tunnel of a road: the map has no such kind": 1,
    }
    assert {reason: left_out.get(reason) for reason in expected} == expected


def test_outlines_in_road_and_in_local_corners(tmp_path: Path) -> None:
    corners = "".join(f'<cornerRoad s="{s}" t="{t}" dz="0.1"/>' for s, t in ((10, 3), (14, 3), (14, -3), (10, -3)))
    found, _ = _taken(tmp_path, _object('type="crosswalk" s="12" t="0"', f"<outline>{corners}</outline>"))
    ring = [[10, 3, 0.1], [14, 3, 0.1], [14, -3, 0.1], [10, -3, 0.1], [10, 3, 0.1]]
    assert found.kind.tolist() == [Kind.CROSSING]
    np.testing.assert_allclose(found.vertices(0), ring, atol=1e-9)
    local = '<cornerLocal u="1" v="0" z="0"/><cornerLocal u="0" v="2" z="0.5"/>'
    outline = f'<outlines><outline closed="false">{local}</outline></outlines>'
    found, _ = _taken(tmp_path, _object('type="barrier" s="12" t="-4" zOffset="1" hdg="1.5707963267948966"', outline))
    assert (found.kind.tolist(), found.style.tolist()) == ([Kind.ROAD_BOUNDARY], [Style.BARRIER])
    np.testing.assert_allclose(found.vertices(0), [[12, -3, 1], [10, -4, 1.5]], atol=1e-9)


def test_objects_repeat(tmp_path: Path) -> None:
    lamps = '<repeat s="10" length="40" distance="20" tStart="-6" tEnd="-8" zOffsetStart="0" zOffsetEnd="0"/>'
    found, _ = _taken(tmp_path, _object('type="pole" s="10" t="-6" height="5"', lamps))
    assert found.kind.tolist() == [Kind.POLE] * 3
    feet = [[10, -6, 0], [30, -7, 0], [50, -8, 0]]
    np.testing.assert_allclose(found.xyz[::2], feet, atol=1e-9)
    np.testing.assert_allclose(found.xyz[1::2] - found.xyz[::2], [[0, 0, 5]] * 3, atol=1e-9)


def test_a_barrier_runs_along_a_curve(tmp_path: Path) -> None:
    rail = '<repeat s="10" length="80" distance="0" tStart="-6" tEnd="-6"/>'
    vector_map, _ = imported(tmp_path, road(LANES, ARC, _object('type="barrier" s="10" t="-6"', rail)))
    row = vector_map.elements.name.tolist().index("road 1 object 7")
    xy = vector_map.elements.vertices(row)[:, :2] - (0.0, 50.0)
    np.testing.assert_allclose(np.hypot(*xy.T), 56.0, atol=1e-9)
    middles = np.hypot(*(0.5 * (xy[1:] + xy[:-1])).T)
    assert 56.0 - middles.min() < 0.01
    np.testing.assert_allclose(50 * np.arctan2(xy[[0, -1], 0], -xy[[0, -1], 1]), [10.0, 90.0], atol=1e-9)


def test_poles_boxes_and_stop_lines_without_outline(tmp_path: Path) -> None:
    boxes = {
        'type="crosswalk" subtype="zebra" length="4" width="6"': (Kind.CROSSING, Style.ZEBRA, 5),
        'type="roadMark" subtype="signalLines" length="0.3" width="6"': (Kind.STOP_LINE, Style.SOLID, 2),
        'type="roadMark" subtype="arrowLeft" length="3" width="1"': (Kind.MARKING, Style.ARROW, 5),
        'type="roadMark" subtype="text"': (Kind.MARKING, Style.UNKNOWN, 1),
        'type="pole" subtype="lamp"': (Kind.POLE, Style.UNKNOWN, 1),
        'type="none" name="StopLine 3" length="0.2" width="3.5"': (Kind.STOP_LINE, Style.SOLID, 2),
        'type="-1" name="StreetLight_2" height="6"': (Kind.POLE, Style.UNKNOWN, 2),
        'type="-1" name="TrafficLight_2" height="6"': (Kind.SIGN, Style.LIGHT, 1),
    }
    for attributes, expected in boxes.items():
        found, _ = _taken(tmp_path, _object(f'{attributes} s="50" t="0"'))
        assert (found.kind[0], found.style[0], len(found.xyz)) == expected, attributes
