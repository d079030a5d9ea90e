"""Map files: what is written comes back, only what is near is read, and what is no map is refused in one line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.columns import FACTS_KEY
from sensors.maps.map_file import open_map
from sensors.maps.store import bytes_by_kind, write_map
from sensors.maps.vector_map import Colour, Elements, Kind, Style, Surfels, VectorMap
from sensors.simulate.city_map import city_map

FRAME = MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32)
HALF_CM = 0.005 + 1e-6
NORMAL_DEG = 0.56


@pytest.fixture(scope="module")
def city() -> VectorMap:
    return city_map(4.0, 3)


@pytest.fixture(scope="module")
def city_path(city: VectorMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("city") / "city.parquet"
    write_map(city, path)
    return path


def back(vector_map: VectorMap, path: Path, tile_m: float = 1000.0) -> VectorMap:
    """Written and read whole."""
    write_map(vector_map, path, tile_m)
    with open_map(path) as opened:
        return opened.whole()


def rough(ratios: np.ndarray) -> np.ndarray:
    """How far off a ratio may come back."""
    return np.sqrt(ratios) / 255 + 4e-6


def same_elements(got: Elements, expected: Elements) -> None:
    for column in ("kind", "style", "colour", "first", "source", "name"):
        np.testing.assert_array_equal(getattr(got, column), getattr(expected, column), err_msg=column)
    np.testing.assert_array_equal(np.isnan(got.xyz), np.isnan(expected.xyz))
    assert np.nanmax(np.abs(got.xyz - expected.xyz), initial=0.0) <= HALF_CM


def same_surfels(got: Surfels, expected: Surfels) -> None:
    assert np.abs(got.p - expected.p).max(initial=0.0) <= HALF_CM
    np.testing.assert_array_equal(np.isnan(got.z), np.isnan(expected.z))
    assert np.nanmax(np.abs(got.z - expected.z), initial=0.0) <= HALF_CM
    np.testing.assert_allclose(np.linalg.norm(got.normal, axis=1), 1.0, atol=1e-12)
    sine = np.linalg.norm(got.normal - expected.normal, axis=1) / 2.0
    assert np.degrees(2.0 * np.arcsin(sine)).max(initial=0.0) <= NORMAL_DEG
    assert (np.abs(got.ratios - expected.ratios) <= rough(expected.ratios)).all()


def by_name(elements: Elements) -> Elements:
    return elements.chosen(np.argsort(elements.name))


coordinates = st.floats(-20_000.0, 20_000.0)
heights = st.one_of(st.just(float("nan")), st.floats(-500.0, 9000.0))
shapes = st.lists(st.tuples(coordinates, coordinates, heights), min_size=1, max_size=6)
elements_of_any_sort = st.lists(
    st.tuples(st.sampled_from(Kind), st.sampled_from(Style), st.sampled_from(Colour), shapes), max_size=8
)
angles = st.tuples(st.floats(0.0, 2.0 * np.pi), st.floats(0.0, np.pi / 2.0))
patches = st.lists(
    st.tuples(coordinates, coordinates, heights, angles, st.floats(0.0, 1.0), st.floats(0.0, 1.0)), max_size=8
)


def surfels_of(rows: list) -> Surfels:
    azimuth, zenith = (np.array([row[3][i] for row in rows]) for i in range(2))
    normal = np.stack((np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)), axis=-1)
    x, y, z, second, third = (np.array([row[i] for row in rows], np.float64) for i in (0, 1, 2, 4, 5))
    return Surfels(np.column_stack((x, y)), z, normal, np.column_stack((second, third)))


@settings(max_examples=60, deadline=None)
@given(elements_of_any_sort, patches, st.sampled_from((10.0, 1000.0, 50_000.0)))
def test_any_map_comes_back_and_goes_in_again_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, shaped: list, rows: list, tile_m: float
) -> None:
    builder = Builder("made up")
    for number, (kind, style, colour, vertices) in enumerate(shaped):
        builder.add(kind, vertices, style, colour, f"{number:02d} Straße")
    given_map = builder.built(FRAME, surfels_of(rows), 1.5)
    folder = tmp_path_factory.mktemp("any")
    found = back(given_map, folder / "a.parquet", tile_m)
    assert (found.frame, found.sources, found.road_km) == (FRAME, ("made up",), 1.5)
    same_elements(by_name(found.elements), given_map.elements)
    # surfels have no name: what came back is put in the order of the given ones by their places
    assert len(found.surfels) == len(rows)
    order, given_order = (
        np.lexsort((np.nan_to_num(np.rint(s.z * 100)), *np.rint(s.p * 100).T))
        for s in (found.surfels, surfels_of(rows))
    )
    if len(np.unique(np.rint(surfels_of(rows).p * 100), axis=0)) == len(rows):
        same_surfels(found.surfels.chosen(order), surfels_of(rows).chosen(given_order))
    again = back(found, folder / "b.parquet", tile_m)
    np.testing.assert_array_equal(again.surfels.normal, found.surfels.normal)
    assert (folder / "b.parquet").read_bytes() == (folder / "a.parquet").read_bytes()


def test_an_empty_map(tmp_path: Path) -> None:
    found = back(VectorMap(FRAME), tmp_path / "a.parquet")
    assert (len(found.elements), len(found.surfels), found.sources, found.road_km) == (0, 0, (), None)
    with open_map(tmp_path / "a.parquet") as opened:
        elements, surfels = opened.around(0.0, 0.0, 1e9)
        assert (len(elements), len(surfels), opened.boxes.shape) == (0, 0, (0, 4))


def test_normals_that_matter_come_back_exactly_and_planes_have_no_side(tmp_path: Path) -> None:
    normal = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0], [-1, 0, 0], [0.6, 0, -0.8]], np.float64)
    count = len(normal)
    surfels = Surfels(
        np.column_stack((np.arange(count), np.zeros(count))), np.zeros(count), normal, np.ones((count, 2))
    )
    found = back(VectorMap(FRAME, surfels=surfels), tmp_path / "a.parquet").surfels
    np.testing.assert_array_equal(found.normal[:4], normal[:4])
    assert found.normal[4] @ (-0.6, 0, 0.8) > np.cos(np.radians(NORMAL_DEG))
    np.testing.assert_array_equal(found.ratios, 1.0)


def test_a_city_comes_back(city: VectorMap, city_path: Path) -> None:
    with open_map(city_path) as opened:
        found = opened.whole()
        assert opened.facts.counts["surfel"] == len(city.surfels)
        assert opened.facts.counts["pole"] == (city.elements.kind == Kind.POLE).sum()
        assert len(opened.boxes) > 4  # it is dense: quartered tiles
    same_elements(by_name(found.elements), by_name(city.elements))
    rows, given_rows = (np.lexsort((s.z, *np.rint(s.p * 100).T)) for s in (found.surfels, city.surfels))
    same_surfels(found.surfels.chosen(rows), city.surfels.chosen(given_rows))


@pytest.mark.parametrize("radius", [0.0, 15.0, 150.0, 5000.0])
def test_what_is_around_a_place_is_what_a_search_of_the_whole_map_finds(
    radius: float, city: VectorMap, city_path: Path
) -> None:
    rng = np.random.default_rng(5)
    with open_map(city_path) as opened:
        whole = opened.whole()
        for place in city.surfels.p[rng.integers(len(city.surfels), size=8)]:
            elements, surfels = opened.around(*place, radius)
            near = np.linalg.norm(whole.surfels.p - place, axis=1) <= radius
            np.testing.assert_array_equal(surfels.p, whole.surfels.p[near])
            first = whole.elements.first[:-1]
            low, high = (f.reduceat(whole.elements.xyz[:, :2], first) for f in (np.minimum, np.maximum))
            away = np.linalg.norm(np.clip(place, low, high) - place, axis=1)
            np.testing.assert_array_equal(elements.name, whole.elements.name[away <= radius])
            assert (elements.kind == whole.elements.kind[away <= radius]).all()


def test_elements_across_tiles_are_found_from_all_of_them(tmp_path: Path) -> None:
    builder = Builder("made up")
    line = np.column_stack((np.linspace(-2_450.0, 2_450.0, 50), np.full(50, -3.0)))
    builder.add(Kind.ROAD_BOUNDARY, line, name="five tiles long")
    builder.add(Kind.POLE, [(-2_400.0, 40.0, 1.0)], name="in the first")
    builder.add(Kind.STOP_LINE, [(999.0, 5.0), (1001.0, 5.0)], name="over a border")
    write_map(builder.built(FRAME), tmp_path / "a.parquet")
    with open_map(tmp_path / "a.parquet") as opened:
        assert len(opened.boxes) == 3  # only tiles in which something begins
        for x in (-2_450.0, -1_500.0, 0.0, 500.0, 2_450.0):
            assert "five tiles long" in opened.around(x, -3.0, 10.0)[0].name
        assert opened.around(2_500.0, -3.0, 49.0)[0].name.tolist() == []
        assert opened.around(1_005.0, 5.0, 4.5)[0].name.tolist() == ["over a border"]
        assert opened.around(-2_400.0, 40.0, 0.0)[0].name.tolist() == ["in the first"]


def test_memory_is_bounded_and_answers_do_not_depend_on_it(city: VectorMap, city_path: Path) -> None:
    places = city.surfels.p[::997]
    with open_map(city_path, cache_mb=1.0) as small, open_map(city_path) as large:
        for x, y in places:
            got, expected = small.around(x, y, 60.0), large.around(x, y, 60.0)
            np.testing.assert_array_equal(got[0].xyz, expected[0].xyz)
            np.testing.assert_array_equal(got[1].p, expected[1].p)
            assert small.cached_bytes <= 1_500_000  # the latest tile at least is kept
        assert large.cached_bytes > 2_000_000


def test_any_parquet_tool_can_read_it(tmp_path: Path) -> None:
    builder = Builder("a map.osm")
    builder.add(Kind.LANE_LINE, [(1.0, -2.0, 3.0), (4.444, 5.0, np.nan)], Style.DASHED, Colour.YELLOW, "way 7")
    surfel = surfels_of([(10.0, 20.0, float("nan"), (0.0, 0.0), 0.04, 0.0)])
    write_map(builder.built(FRAME, surfel), tmp_path / "a.parquet")
    rows = pq.read_table(tmp_path / "a.parquet").to_pylist()
    nothing = dict.fromkeys(("normal_u", "normal_v", "ratio_2", "ratio_3"))
    lane = {"kind": "lane_line", "style": "dashed", "colour": "yellow", "source": 0, "name": "way 7"}
    assert rows[0] == {**lane, "x": [100, 444], "y": [-200, 500], "z": [300, None], **nothing}
    codes = {"normal_u": 127, "normal_v": 127, "ratio_2": 51, "ratio_3": 0}
    unsaid = dict.fromkeys(("style", "colour", "source", "name"))
    assert rows[1] == {"kind": "surfel", **unsaid, "x": [1000], "y": [2000], "z": [None], **codes}
    facts = json.loads(pq.read_metadata(tmp_path / "a.parquet").metadata[FACTS_KEY])
    # the line begins below the x axis, the surfel lies above it
    assert (facts["version"], facts["tile_m"]) == (1, 1000.0)
    assert facts["tiles"] == [[100, -200, 444, 500], [1000, 2000, 1000, 2000]]
    assert facts["frame"] == {"kind": "utm", "origin": [455_000.0, 5_427_000.0, 0.0], "zone": 32, "south": False}
    assert set(facts["counts"].items()) >= {("lane_line", 1), ("surfel", 1), ("pole", 0)}


def test_a_city_is_as_small_as_promised(city: VectorMap, tmp_path: Path) -> None:
    assert city.road_km is not None
    assert len(city.surfels) >= 10_000 * city.road_km
    write_map(city, tmp_path / "all.parquet")
    assert (tmp_path / "all.parquet").stat().st_size <= 0.30e6 * city.road_km
    write_map(replace(city, surfels=city.surfels.chosen(slice(0))), tmp_path / "elements.parquet")
    assert (tmp_path / "elements.parquet").stat().st_size <= 0.10e6 * city.road_km
    sizes = bytes_by_kind(city)
    assert max(sizes, key=lambda word: sizes[word]) == "surfel"
    assert (tmp_path / "elements.parquet").stat().st_size < sum(sizes.values()) - sizes["surfel"]
    with open_map(tmp_path / "all.parquet") as opened:
        columns = opened.column_bytes()
    assert 0.99 < sum(columns.values()) / (tmp_path / "all.parquet").stat().st_size <= 1.0
