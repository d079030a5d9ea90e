"""Lane lines and edges of OpenDRIVE roads against closed forms."""

from pathlib import Path

import numpy as np
import pytest

from sensors.maps.vector_map import Colour, Floats, Kind, Style
from tests.sensors.maps.xodr import ARC, LINE, RIGHT, WIDTH, imported, only, road, section


def test_borders_of_a_curved_road_with_changing_widths(tmp_path: Path) -> None:
    """Reference line: a circle of 50 m around (0, 50). Widths and offset are cubics of s; a point's s is its angle."""
    wide = '<width sOffset="0" a="3" b="0" c="0.001" d="-6.666666666666667e-6"/>'
    wide += '<width sOffset="60" a="5.16" b="0.02" c="0" d="0"/>'
    mark = '<roadMark sOffset="0" type="solid" color="yellow"/>'
    left = (
        f'<left><lane id="2" type="driving">{WIDTH}{mark}</lane><lane id="1" type="driving">{wide}{mark}</lane></left>'
    )
    centre = f'<center><lane id="0" type="none">{mark}</lane></center>'
    offset = '<laneOffset s="0" a="0" b="0.01" c="0" d="0"/>'
    vector_map, _ = imported(tmp_path, road(offset + section(left + centre), ARC))
    lines = only(vector_map, Kind.LANE_LINE).elements
    assert lines.name.tolist() == [f"road 1 lane {lane} s 0.0" for lane in (0, 1, 2)]
    assert set(lines.colour) == {Colour.YELLOW}
    for row, beside in enumerate((0.0, 1.0, 1.0)):
        s, radius = _around(lines.vertices(row))
        np.testing.assert_allclose(radius, 50.0 - _t(s, beside, 3.5 * (row == 2)), atol=1e-6)
        np.testing.assert_allclose(s[[0, -1]], [0.0, 100.0], atol=1e-9)
        s, radius = _around(0.5 * (lines.vertices(row)[1:] + lines.vertices(row)[:-1]))
        assert np.abs(radius - 50.0 + _t(s, beside, 3.5 * (row == 2))).max() < 0.01  # the middles of chords


def _around(xyz: Floats) -> tuple[Floats, Floats]:
    """s m and radius m about (0, 50) of points (n, 3)."""
    x, y = xyz[:, 0], xyz[:, 1] - 50.0
    return 50.0 * np.unwrap(np.arctan2(x, -y)), np.hypot(x, y)


def _t(s: Floats, beside: float, more: float) -> Floats:
    """Where the border lies: offset, the changing lane beside the middle, and one of constant width."""
    width = np.where(s < 60.0, 3.0 + 0.001 * s**2 - 6.666666666666667e-6 * s**3, 5.16 + 0.02 * (s - 60.0))
    return 0.01 * s + beside * width + more


def test_borders_given_as_borders(tmp_path: Path) -> None:
    mark = '<roadMark sOffset="0" type="broken"/>'
    lanes = "".join(
        f'<lane id="-{row}" type="driving"><border sOffset="0" a="-{t}" b="-0.01" c="0" d="0"/>{mark}</lane>'
        for row, t in ((1, 3.0), (2, 7.0))
    )
    vector_map, _ = imported(tmp_path, road(section(f"<right>{lanes}</right>")))
    lines = only(vector_map, Kind.LANE_LINE).elements
    np.testing.assert_allclose(lines.vertices(0), [[0, -3, 0], [100, -4, 0]], atol=1e-9)
    np.testing.assert_allclose(lines.vertices(1), [[0, -7, 0], [100, -8, 0]], atol=1e-9)


def test_paint_lies_on_the_surface(tmp_path: Path) -> None:
    """Elevation, superelevation, a lane kept level, and the height of a lane's outer edge."""
    mark = '<roadMark sOffset="0" type="solid"/>'
    high = '<height sOffset="0" inner="0" outer="0.12"/>'
    inner = f'<lane id="-1" type="driving">{WIDTH}{mark}</lane>'
    lanes = f'{inner}<lane id="-2" type="sidewalk" level="true">{WIDTH}{high}{mark}</lane>'
    more = """<elevationProfile><elevation s="0" a="10" b="0.05" c="0" d="0"/></elevationProfile>
    <lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>"""
    vector_map, _ = imported(tmp_path, road(section(f"<right>{lanes}</right>"), more=more))
    lines = only(vector_map, Kind.LANE_LINE).elements
    y, z = -3.5 * np.cos(0.1), -3.5 * np.sin(0.1)
    np.testing.assert_allclose(lines.vertices(0), [[0, y, 10 + z], [100, y, 15 + z]], atol=1e-9)
    np.testing.assert_allclose(lines.vertices(1), [[0, y - 3.5, 10.12 + z], [100, y - 3.5, 15.12 + z]], atol=1e-9)


@pytest.mark.parametrize(
    ("mark", "lane", "kind", "style", "colour"),
    [
        ('type="solid" color="standard"', -1, Kind.LANE_LINE, Style.SOLID, Colour.WHITE),
        ('type="broken" color="yellow"', 1, Kind.LANE_LINE, Style.DASHED, Colour.YELLOW),
        ('type="solid broken" color="blue"', -1, Kind.LANE_LINE, Style.SOLID_DASHED, Colour.BLUE),
        ('type="solid broken"', 1, Kind.LANE_LINE, Style.DASHED_SOLID, Colour.WHITE),
        ('type="broken solid" color="violet"', 1, Kind.LANE_LINE, Style.SOLID_DASHED, Colour.UNKNOWN),
        ('type="botts dots"', 1, Kind.LANE_LINE, Style.DOTS, Colour.WHITE),
        ('type="curb"', 1, Kind.ROAD_BOUNDARY, Style.CURB, Colour.UNKNOWN),
        ('type="brand new"', -1, Kind.LANE_LINE, Style.UNKNOWN, Colour.WHITE),
    ],
)
def test_a_road_mark_has_its_looks(
    tmp_path: Path, mark: str, lane: int, kind: Kind, style: Style, colour: Colour
) -> None:
    side = "left" if lane > 0 else "right"
    one = f'<{side}><lane id="{lane}" type="driving">{WIDTH}<roadMark sOffset="0" {mark}/></lane></{side}>'
    elements = imported(tmp_path, road(section(one)))[0].elements
    assert (kind, style, colour) in set(zip(elements.kind, elements.style, elements.colour, strict=True))
    assert len(elements) == (3 if kind == Kind.LANE_LINE else 2)  # two edges; a marked one is not taken twice


def test_road_marks_change_at_their_offsets(tmp_path: Path) -> None:
    marks = """<roadMark sOffset="10" type="solid"/><roadMark sOffset="30" type="none"/>
    <roadMark sOffset="40" type="broken"><type name="x"><line tOffset="0.2"/></type></roadMark>
    <roadMark sOffset="50" type="solid"/>"""
    one = f'<right><lane id="-1" type="driving">{WIDTH}{marks}</lane></right>'
    vector_map, left_out = imported(tmp_path, road(section(RIGHT) + section(one, 50.0)))
    lines = only(vector_map, Kind.LANE_LINE).elements
    ends = [lines.vertices(row)[:, :2].tolist() for row in range(len(lines))]
    expected = [[[0, -3.5], [50, -3.5]], [[60, -3.5], [80, -3.5]], [[90, -3.3], [100, -3.3]]]
    np.testing.assert_allclose(ends, expected, atol=1e-9)
    assert left_out["road marks without length"] == 1


def test_a_section_of_one_side_leaves_the_other_as_it_is(tmp_path: Path) -> None:
    left = RIGHT.replace("right", "left").replace("-1", "1")
    single = f'<laneSection s="40" singleSide="true">{left}</laneSection>'
    vector_map, _ = imported(tmp_path, road(section(RIGHT + left) + single))
    lines = only(vector_map, Kind.LANE_LINE).elements
    spans = {lane: [] for lane in (-1, 1)}  # type: dict[int, list[list[float]]]
    for row in range(len(lines)):
        xyz = lines.vertices(row)
        spans[int(np.sign(xyz[0, 1]))].append(xyz[:, 0].tolist())
    assert spans == {-1: [[0.0, 40.0], [40.0, 100.0]], 1: [[0.0, 40.0], [40.0, 100.0]]}


def _edges(folder: Path, lanes: str, attributes: str = 'id="1" junction="-1"') -> list[tuple[float, Style]]:
    vector_map, _ = imported(folder, road(section(lanes), attributes=attributes))
    edges = only(vector_map, Kind.ROAD_BOUNDARY).elements
    return sorted((float(edges.vertices(row)[0, 1]), Style(edges.style[row])) for row in range(len(edges)))


def test_edges_stand_where_the_road_ends(tmp_path: Path) -> None:
    def lane(number: int, kind: str, more: str = "") -> str:
        return f'<lane id="{number}" type="{kind}">{WIDTH}{more}</lane>'

    high = '<height sOffset="0" inner="0.12" outer="0.12"/>'
    walk = f"<left>{lane(1, 'driving')}{lane(2, 'sidewalk', high)}</left>"
    verge = f"<right>{lane(-1, 'driving')}{lane(-2, 'shoulder')}{lane(-3, 'none')}{lane(-4, 'biking')}</right>"
    edge, curb = Style.ROAD_EDGE, Style.CURB
    assert _edges(tmp_path, walk + verge) == [(-14.0, edge), (-10.5, edge), (-7.0, edge), (3.5, curb)]
    assert _edges(tmp_path, RIGHT) == [(-3.5, edge), (0.0, edge)]
    assert _edges(tmp_path, walk, 'id="1" junction="5"') == [(3.5, curb)]
    assert _edges(tmp_path, RIGHT, 'id="1" junction="5"') == []
    assert _edges(tmp_path, f"<left>{lane(1, 'sidewalk')}</left>{RIGHT}") == [(-3.5, edge), (0.0, edge)]


def test_a_lane_offset_that_jumps_between_sections_bends_no_line(tmp_path: Path) -> None:
    offset = '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="50" a="3.5" b="0" c="0" d="0"/>'
    lines = only(imported(tmp_path, road(offset + section(RIGHT) + section(RIGHT, 50.0)))[0], Kind.LANE_LINE).elements
    ends = [lines.vertices(row)[:, :2].tolist() for row in range(len(lines))]
    np.testing.assert_allclose(ends, [[[0, -3.5], [50, -3.5]], [[50, 0], [100, 0]]], atol=1e-9)


def test_a_parametric_cubic_is_read_by_length_or_by_share(tmp_path: Path) -> None:
    """The same curve twice: u = s - 1e-5 s^3, v = 0.01 s^2 over 100 m."""
    forms = {
        "arcLength": 'aU="0" bU="1" cU="0" dU="-1e-5" aV="0" bV="0" cV="0.01" dV="0"',
        "normalized": 'aU="0" bU="100" cU="0" dU="-10" aV="0" bV="0" cV="100" dV="0"',
    }
    for span, coefficients in forms.items():
        geometry = LINE.replace("<line/>", f'<paramPoly3 pRange="{span}" {coefficients}/>')
        mark = '<center><lane id="0" type="none"><roadMark sOffset="0" type="solid"/></lane></center>'
        line = only(imported(tmp_path, road(section(mark), geometry))[0], Kind.LANE_LINE).elements.vertices(0)
        s = np.sqrt(line[:, 1] / 0.01)
        assert len(line) > 10
        np.testing.assert_allclose(line[:, 0], s - 1e-5 * s**3, atol=1e-6)
        np.testing.assert_allclose(line[-1], [90, 100, 0], atol=1e-9)


def test_crossfall_and_shape_lower_the_paint_of_their_side(tmp_path: Path) -> None:
    both = RIGHT + RIGHT.replace("right", "left").replace("-1", "1")
    fall = '<lateralProfile><crossfall side="right" s="0" a="0.02" b="0" c="0" d="0"/></lateralProfile>'
    lines = only(imported(tmp_path, road(section(both), more=fall))[0], Kind.LANE_LINE).elements
    heights = {lines.vertices(row)[0, 1]: lines.vertices(row)[0, 2] for row in range(2)}
    assert heights == pytest.approx({-3.5: -3.5 * np.tan(0.02), 3.5: 0.0})
    roof = '<shape s="0" t="-4" a="0" b="0.1" c="0" d="0"/><shape s="0" t="0" a="0.4" b="-0.05" c="0" d="0"/>'
    lines = only(
        imported(tmp_path, road(section(both), more=f"<lateralProfile>{roof}</lateralProfile>"))[0], Kind.LANE_LINE
    ).elements
    heights = {lines.vertices(row)[0, 1]: lines.vertices(row)[0, 2] for row in range(2)}
    assert heights == pytest.approx({-3.5: 0.05, 3.5: 0.4 - 0.175})
