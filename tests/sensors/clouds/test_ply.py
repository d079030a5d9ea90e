"""PLY files of every form, with elements around the vertices, and headers that cannot be."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors.clouds import read_cloud
from tests.sensors.clouds.made_clouds import (
    CLOUDS,
    XYZ,
    ply,
    points,
    quick,
    refused,
    written,
)

FORMS = ["ascii", "binary_little_endian", "binary_big_endian"]


@quick
@given(xyz=CLOUDS, form=st.sampled_from(FORMS), kind=st.sampled_from(["f4", "f8"]), order=st.permutations("xyz"))
def test_ply_comes_back(tmp_path: Path, xyz: Any, form: str, kind: str, order: list[str]) -> None:
    made = points(xyz, kind, "".join(order), red=("u1", 200), nx=("f8", 0.25))
    cloud = read_cloud(written(tmp_path, "a.ply", ply(made, form, tail=b"3 0 1 2\n")))
    np.testing.assert_array_equal(cloud.xyz, xyz)
    assert (cloud.frame, cloud.viewpoint, cloud.left_out) == (None, None, ())


FACES = "element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\nproperty short end"
CAMERA = "element camera 1\nproperty double fov\nproperty int id"


@pytest.mark.parametrize("form", FORMS)
def test_ply_elements_in_front_are_passed_over(tmp_path: Path, form: str) -> None:
    o = ">" if "big" in form else "<"
    faces = struct.pack(f"{o}BB3ihBBh", 1, 3, 0, 1, 2, -1, 0, 0, 9)
    camera = struct.pack(f"{o}di", 1.5, 3)
    if form == "ascii":
        faces, camera = b"1 3 0 1 2 -1\n0 0 9\n", b"1.5 3\n"
    data = ply(points(XYZ), form, [(FACES, faces), (CAMERA, camera)])
    np.testing.assert_array_equal(read_cloud(written(tmp_path, "a.ply", data)).xyz, XYZ)


@pytest.mark.parametrize("form", FORMS[1:])
def test_ply_vertices_with_lists(tmp_path: Path, form: str) -> None:
    o = ">" if "big" in form else "<"
    header = (
        f"ply\r\nformat {form} 1.0\r\nelement vertex 3\r\nproperty list ushort float seen\r\nproperty double x\r\n"
        "property float y\r\nproperty list uchar char more\r\nproperty short z\r\nend_header\r\n"
    )
    body = struct.pack(f"{o}H2fdfBh", 2, 0.5, 0.5, 1.0, 2.0, 0, 3) + struct.pack(f"{o}HdfB2bh", 0, 4.0, 5.0, 2, 1, 1, 6)
    body += struct.pack(f"{o}HfdfBbh", 1, 0.5, 7.0, 8.0, 1, 9, -9)
    path = written(tmp_path, "a.ply", header.encode() + body)
    assert read_cloud(path).xyz.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, -9]]
    refused(
        written(tmp_path, "a.ply", header.encode() + body[:-1]), "element vertex: the header claims 3 records, .* 1 by"
    )


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (b"ply\n", b"plx\n", "expected a PLY file, its first bytes are 70 6c 78"),
        (b"vertex 3", b"vertex 4", "element vertex: the header claims 4 records, the file ends 12 bytes before"),
        (b"vertex 3", b"vertex -3", "line 4: expected a line of a PLY header, got 'element vertex -3'"),
        (b"vertex 3", b"vertex nan", "line 4: expected a line of a PLY header"),
        (b"vertex 3", b"vertex 1000000000000", "element vertex: 1000000000000 points take .* GB of memory"),
        (b"vertex 3", b"corner 3", "element vertex: expected one, got corner"),
        (b"little", b"middle", "line 2: expected a line of a PLY header"),
        (b"float z", b"float w", "element vertex: expected a number z, got properties x y w"),
        (b"float z", b"float x", "element vertex: expected a number x"),
        (b"float z", b"list uchar float z", "element vertex: expected a number z"),
        (b"float z", b"list float float z", "line 7: expected a line of a PLY header"),
        (b"float z", b"quad z", "line 7: expected a line of a PLY header, got 'property quad z'"),
        (b"end_header\n", b"", "line 8: expected a line of a PLY header|expected a PLY header that ends"),
        (b"format binary_little_endian 1.0\n", b"", "format: expected one of ascii"),
    ],
)
def test_ply_headers_that_cannot_be(tmp_path: Path, old: bytes, new: bytes, told: str) -> None:
    data = ply(points(XYZ), "binary_little_endian")
    assert old in data
    refused(written(tmp_path, "a.ply", data.replace(old, new, 1)), told)


def test_ply_lists_that_cannot_be(tmp_path: Path) -> None:
    for records, length, told in (
        (10**9, 0, "element face: the header claims 1000000000 records"),
        (2, -1, "element face: record 0: a list of -1 numbers"),
        (2, 1 << 30, "element face: the header claims 2 records, the file ends"),
    ):
        lines = f"element face {records}\nproperty list int double n"
        data = ply(points(XYZ), "binary_little_endian", [(lines, struct.pack("<ii", length, 0))])
        refused(written(tmp_path, "a.ply", data), told)


def test_ply_text_that_is_none(tmp_path: Path) -> None:
    data = ply(points(XYZ), "ascii")
    refused(written(tmp_path, "a.ply", data.replace(b"-2.25", b"?")), "expected lines of numbers behind the header")
    refused(written(tmp_path, "a.ply", data.replace(b"vertex 3", b"vertex 4")), "says 4 points, the file has 3")
    refused(written(tmp_path, "a.ply", data.replace(b"vertex 3", b"vertex 4000")), "do not fit into the .* bytes")
