"""Files that are no map, or no whole one: one line that names the file; and maps that a file cannot hold."""

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.columns import FACTS_KEY
from sensors.maps.map_file import open_map
from sensors.maps.store import write_map
from sensors.maps.vector_map import Kind, Surfels, VectorMap

FRAME = MapFrame("enu", (49.0, 8.4, 110.0))


def small_map(x: float = 1.0) -> VectorMap:
    builder = Builder("made up")
    for number in range(40):
        builder.add(Kind.LANE_LINE, [(x, number, 1.0), (x + 1.0, number, 2.0)], name=f"way {number}")
    up = np.tile((0.0, 0.0, 1.0), (50, 1))
    return builder.built(
        FRAME, Surfels(np.random.default_rng(0).uniform(0.0, 50.0, (50, 2)), np.zeros(50), up, up[:, :2])
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_map(small_map(), tmp_path / "map.parquet")
    return tmp_path / "map.parquet"


def refused(path: Path) -> str:
    """The one line with which a file is refused when it is opened or read, naming it."""
    with pytest.raises(EgolocError) as error, open_map(path) as opened:
        opened.around(0.0, 0.0, 1000.0)
    said = str(error.value)
    assert "\n" not in said
    assert said.startswith(f"{path}: ")
    return said


def changed(path: Path, change: Callable[[pa.Table, dict], tuple[pa.Table, dict]]) -> str:
    """What is said of a map file that somebody changed: its table, its facts."""
    table, facts = change(pq.read_table(path), msgspec.json.decode(pq.read_metadata(path).metadata[FACTS_KEY]))
    with pq.ParquetWriter(path, table.schema, store_schema=False) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({FACTS_KEY: msgspec.json.encode(facts)})
    return refused(path)


def test_what_is_no_parquet_file(tmp_path: Path) -> None:
    assert "cannot be read: No such file" in refused(tmp_path / "none.parquet")
    assert "cannot be read" in refused(tmp_path)
    for text in (b"", b"<osm/>", b"PAR1" * 20):
        (tmp_path / "a.parquet").write_bytes(text)
        assert "expected a map of egoloc, got no whole Parquet file" in refused(tmp_path / "a.parquet")


def test_another_parquet_file(tmp_path: Path) -> None:
    pq.write_table(pa.table({"x": [1, 2]}), tmp_path / "a.parquet")
    assert refused(tmp_path / "a.parquet").endswith("expected a map of egoloc, got another Parquet file")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_truncated_files(share: float, path: Path) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    assert "no whole Parquet file" in refused(path)


def test_damage_is_found_wherever_it_is(path: Path) -> None:
    """One byte at a time: it is refused in one line; where nothing depends on the byte, the same comes out."""
    whole = path.read_bytes()
    with open_map(path) as opened:
        expected = opened.whole()
    said = []
    for place in range(4, len(whole) - 8, 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            with open_map(path) as opened:
                got = opened.whole()
        except EgolocError as error:
            said.append(str(error))
        else:
            np.testing.assert_array_equal(got.elements.xyz, expected.elements.xyz)
            np.testing.assert_array_equal(got.surfels.normal, expected.surfels.normal)
    assert len(said) > 200
    assert all(line.startswith(f"{path}: ") and "\n" not in line for line in said)


@pytest.mark.parametrize(
    ("fact", "value", "said"),
    [
        ("version", 2, "expected a map of version 1, got version 2"),
        ("version", None, "footer: Expected `int`, got `null`"),
        ("tiles", [], "expected 0 tiles, got 1"),
        ("tiles", [[1, 2]], "footer: Expected `array` of length 4"),
        ("frame", {"kind": "utm"}, "map frame: zone: expected 1..60, got 0"),
        ("sources", [], "tile 0: source: expected 0..-1, got 0"),
        ("unheard", 1, "unknown field `unheard`"),
    ],
)
def test_facts_that_are_wrong(fact: str, value: object, said: str, path: Path) -> None:
    assert said in changed(path, lambda table, facts: (table, {**facts, fact: value}))


def test_columns_that_are_wrong(path: Path) -> None:
    whole, x = path.read_bytes(), pq.read_table(path).column("x").to_pylist()

    def said_of(name: str, values: pa.Array) -> str:
        path.write_bytes(whole)

        def change(table: pa.Table, facts: dict) -> tuple[pa.Table, dict]:
            return table.set_column(table.schema.get_field_index(name), name, values), facts

        return changed(path, change)

    lists = pa.list_(pa.int32())
    said = said_of("kind", pa.array(["lane_line"] * 89 + ["tram"]))
    assert "tile 0: kind: expected one of lane_line, " in said
    assert said.endswith("surfel, got 'tram'")
    assert "expected all surfels after the elements" in said_of("kind", pa.array(["surfel"] * 89 + ["pole"]))
    assert "expected one vertex of each surfel" in said_of("kind", pa.array(["pole"] * 39 + ["surfel"] * 51))
    assert "style: expected numbers, got 40 nulls" in said_of("style", pa.nulls(90, pa.string()))
    assert "source: expected 0..0, got 3" in said_of("source", pa.array([3] * 90, pa.int32()))
    assert "x, y, z: expected lists of the same lengths" in said_of("z", pa.array([[1]] * 90, lists))
    assert "x: expected lists, got 90 nulls" in said_of("x", pa.nulls(90, lists))
    assert "x: expected numbers, got" in said_of("x", pa.array([[1, None]] * 40 + [[1]] * 50, lists))
    assert "x: expected surfels by rising x" in said_of("x", pa.array(x[:50] + x[50:][::-1], lists))
    assert "expected the columns kind" in said_of("x", pa.array([1.0] * 90))


def test_maps_that_a_file_cannot_hold(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.parquet"

    def refused_to_write(vector_map: VectorMap, said: str, **options: float) -> None:
        with pytest.raises(EgolocError, match=re.escape(said)):
            write_map(vector_map, path, **options)
        assert not path.exists()
        assert not [*path.parent.glob("*"), *path.parent.glob(".*")]

    refused_to_write(small_map(3e7), "way 0: expected coordinates within 21,474 km")
    one = np.ones((1, 2))
    long = Surfels(one, np.zeros(1), np.array([[0.0, 0.0, 2.0]]), one)
    refused_to_write(VectorMap(FRAME, surfels=long), "Surfels.normal: expected unit vectors, got length 2 in row 0")
    thick = Surfels(one, np.zeros(1), np.array([[0.0, 0.0, 1.0]]), 3.0 * one)
    refused_to_write(VectorMap(FRAME, surfels=thick), "Surfels.ratios: expected 0..1, got 3 in row 0")
    far = Surfels(3e7 * one, np.zeros(1), np.array([[0.0, 0.0, 1.0]]), one)
    refused_to_write(VectorMap(FRAME, surfels=far), "surfel 0: expected coordinates within 21,474 km")
    refused_to_write(small_map(), "tile_m: expected 1..100000, got 0", tile_m=0.0)
    refused_to_write(small_map(), "tile_m: expected 1..100000, got nan", tile_m=float("nan"))


def test_a_place_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "a.parquet", tmp_path / "folder"):
        with pytest.raises(EgolocError, match=re.escape(f"{path}: cannot be written: ")):
            write_map(small_map(), path)
    assert sorted(found.name for found in tmp_path.iterdir()) == ["file", "folder"]


def test_a_failed_writing_leaves_the_old_file(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(EgolocError):
        write_map(small_map(3e7), path)
    assert path.read_bytes() == before
