"""PCD files of every kind, and headers that cannot be."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors.clouds import read_cloud
from sensors.clouds._kernels import lzf_decompress
from tests.sensors.clouds.made_clouds import (
    CLOUDS,
    XYZ,
    lzf,
    lzf_literals,
    pcd,
    points,
    quick,
    refused,
    written,
)

KINDS = ["ascii", "binary", "binary_compressed"]


@quick
@given(xyz=CLOUDS, data=st.sampled_from(KINDS), kind=st.sampled_from(["f4", "f8"]), order=st.permutations("xyz"))
def test_pcd_comes_back(tmp_path: Path, xyz: Any, data: str, kind: str, order: list[str]) -> None:
    made = points(xyz, kind, "".join(order), rgb=("u4", 7), normal=(("<f4", (3,)), 0.5), _=("u1", 1))
    cloud = read_cloud(written(tmp_path, "a.pcd", pcd(made, data)))
    np.testing.assert_array_equal(cloud.xyz, xyz)
    assert (cloud.frame, cloud.viewpoint, cloud.left_out) == (None, None, ())


@pytest.mark.parametrize("kind", ["i1", "i2", "i4", "u1", "u2", "u4", "i8", "u8"])
@pytest.mark.parametrize("data", KINDS)
def test_pcd_of_whole_numbers(tmp_path: Path, kind: str, data: str) -> None:
    xyz = np.array([[1, 2, 3], [100, 0, 9]])
    cloud = read_cloud(written(tmp_path, "a.pcd", pcd(points(xyz, kind), data)))
    np.testing.assert_array_equal(cloud.xyz, xyz)


def test_pcd_viewpoint_organized_and_not_finite(tmp_path: Path) -> None:
    xyz = np.array([[1, 2, 3], [np.nan] * 3, [4, 5, 6], [7, np.inf, 9.0]])
    data = pcd(points(xyz), "binary", WIDTH="2", HEIGHT="2", POINTS=None, VIEWPOINT="10 20 30.5 1 0 0 0", COUNT=None)
    cloud = read_cloud(written(tmp_path, "a.PCD", data))
    assert cloud.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.viewpoint is not None
    assert cloud.viewpoint.tolist() == [10, 20, 30.5]
    assert [entry.count for entry in cloud.left_out] == [2]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"POINTS": str(10**12), "WIDTH": str(10**12)}, "POINTS: 1000000000000 points take .* GB of memory"),
        ({"POINTS": "4", "WIDTH": "4"}, "POINTS: the header claims 48 bytes of points, the file has 36"),
        ({"POINTS": "-1", "WIDTH": "-1"}, "POINTS: expected 0 or more points, got -1"),
        ({"POINTS": "2"}, "POINTS: 2 points are not WIDTH 3 times HEIGHT 1"),
        ({"POINTS": "inf"}, "POINTS: expected 1 whole numbers, got inf"),
        ({"POINTS": "9" * 400}, "POINTS: expected numbers of points"),
        ({"POINTS": None, "WIDTH": None}, "POINTS: expected 1 whole numbers, got none"),
        ({"FIELDS": "x y w"}, "FIELDS: expected one z, got x y w"),
        ({"FIELDS": "x y z z"}, "FIELDS: expected one z"),
        ({"SIZE": "4 4"}, "SIZE: expected 3 whole numbers, got 4 4"),
        ({"SIZE": "4 4 3"}, "field z: expected F, I or U of 1 to 8 bytes, got 1 of F 3"),
        ({"TYPE": "F F"}, "TYPE: expected 3 types, got 2"),
        ({"TYPE": "F F Q"}, "field z: expected F, I or U"),
        ({"COUNT": "1 1 2"}, "field z: COUNT: expected 1, got 2"),
        ({"COUNT": "1 1 -1"}, "field z: expected F, I or U"),
        (
            {"FIELDS": "x y z a", "SIZE": "4 4 4 8", "TYPE": "F F F F", "COUNT": "1 1 1 99999999"},
            "at most 16777216 bytes",
        ),
        ({"VIEWPOINT": "0 0 nan 1 0 0 0"}, "VIEWPOINT: expected 7 finite numbers"),
        ({"VIEWPOINT": "0 0 0"}, "VIEWPOINT: expected 7 finite numbers, got 0 0 0"),
        ({"DATA": "binary_zip"}, "DATA: expected ascii, binary or binary_compressed, got 'binary_zip'"),
    ],
)
def test_pcd_headers_that_cannot_be(tmp_path: Path, changed: dict[str, str | None], told: str) -> None:
    refused(written(tmp_path, "a.pcd", pcd(points(XYZ), "binary", **changed)), told)


def test_pcd_text_that_is_none(tmp_path: Path) -> None:
    made = points(XYZ)
    data = pcd(made, "ascii")
    refused(written(tmp_path, "a.pcd", data.replace(b"-2.25", b"minus")), "expected lines of numbers behind the header")
    refused(written(tmp_path, "a.pcd", pcd(made, "ascii", WIDTH="4", POINTS="4")), "says 4 points, the file has 3")
    refused(written(tmp_path, "a.pcd", pcd(made, "ascii", WIDTH="999", POINTS="999")), "999 points do not fit into the")
    refused(
        written(tmp_path, "a.pcd", b"# .PCD v0.7\nFIELDS x y z\n"), "expected a PCD header that ends with a line DATA"
    )
    refused(written(tmp_path, "a.pcd", bytes(1 << 18)), "expected a PCD header")


@pytest.mark.parametrize(
    ("packed", "told"),
    [
        (lambda plain: lzf_literals(plain + b"more"), "does not expand to the 36 bytes"),
        (lambda plain: lzf_literals(plain[:-1]), "does not expand to the 36 bytes"),
        (lambda plain: lzf_literals(plain)[:-1], "does not expand to the 36 bytes"),
        (
            lambda plain: b"\xff\xff\xff" + lzf_literals(plain),
            "does not expand to the 36 bytes",
        ),  # from before the start
    ],
)
def test_pcd_compressed_data_that_cannot_be(tmp_path: Path, packed: Any, told: str) -> None:
    refused(written(tmp_path, "a.pcd", pcd(points(XYZ), "binary_compressed", packed)), told)


def test_pcd_compressed_sizes_that_cannot_be(tmp_path: Path) -> None:
    good = pcd(points(XYZ), "binary_compressed")
    at = good.index(b"binary_compressed\n") + len(b"binary_compressed\n")
    for sizes, told in (
        ((10**9, 36), "DATA: the header claims 1000000000 bytes"),
        ((4, 37), "expected 36 bytes for 3 points, the data claims 37"),
    ):
        refused(written(tmp_path, "a.pcd", good[:at] + struct.pack("<II", *sizes) + good[at + 8 :]), told)
    bomb = pcd(points(np.zeros((10**6, 3))), "binary_compressed", lambda _: b"\0\0\xe0\xff\0")
    refused(written(tmp_path, "a.pcd", bomb), "5 compressed bytes cannot hold the 12000000")
    refused(written(tmp_path, "a.pcd", good[:at] + b"\0\0\0"), "the file ends before the sizes")


@quick
@given(st.binary(max_size=300) | st.builds(lambda a, n: a * n, st.binary(min_size=1, max_size=9), st.integers(1, 200)))
def test_lzf_comes_back(data: bytes) -> None:
    for packed in (lzf(data), lzf_literals(data)):
        out = np.zeros(len(data), np.uint8)
        assert lzf_decompress(np.frombuffer(packed, np.uint8), out) == len(data)
        assert out.tobytes() == data


@quick
@given(st.binary(max_size=60), st.integers(0, 50))
def test_lzf_of_anything_stays_inside(packed: bytes, room: int) -> None:
    out = np.full(room + 8, 77, np.uint8)
    got = lzf_decompress(np.frombuffer(packed, np.uint8), out[:room])
    assert -1 <= got <= room
    assert (out[room:] == 77).all()
