"""Point clouds of every format: what was written comes back, damage is one line that names the file."""

import struct
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pyproj import CRS

from sensors.clouds import read_cloud
from sensors.clouds._kernels import lzf_decompress
from sensors.clouds.cloud import check_room
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, map_from_llh
from tests.sensors.clouds.made_clouds import lzf, lzf_literals, pcd, ply, points

XYZ = np.array([[1.5, -2.25, 3.0], [400.125, 0.0, -7.5], [0.0, 0.0, 0.0]])
CLOUDS = hnp.arrays(np.float64, st.tuples(st.integers(0, 30), st.just(3)), elements=st.floats(-1e6, 1e6, width=32))
FORMS = ["ascii", "binary_little_endian", "binary_big_endian"]
KINDS = ["ascii", "binary", "binary_compressed"]
quick = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def refused(path: Path, told: str) -> None:
    with pytest.raises(EgolocError, match=told) as raised:
        read_cloud(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


# PCD


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


# PLY


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


# LAS and LAZ


def las(xyz: Any, epsg: int | str | None = None, compress: bool = False, **fields: Any) -> bytes:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.array([1e-7, 1e-7, 1e-3] if epsg == 4326 else [1e-3] * 3)
    header.offsets = np.floor(np.asarray(xyz)[0]) if len(xyz) else np.zeros(3)
    if epsg is not None:
        header.add_crs(CRS.from_user_input(epsg))
    made = laspy.LasData(header)
    made.x, made.y, made.z = np.asarray(xyz).T
    for name, values in fields.items():
        setattr(made, name, values)
    stream = BytesIO()
    made.write(stream, do_compress=compress)
    return stream.getvalue()


@quick
@given(
    xyz=hnp.arrays(np.float64, (7, 3), elements=st.integers(-(10**6), 10**6).map(lambda n: n / 1000)), laz=st.booleans()
)
def test_las_comes_back(tmp_path: Path, xyz: Any, laz: bool) -> None:
    cloud = read_cloud(written(tmp_path, "a.laz" if laz else "a.las", las(xyz, compress=laz)))
    np.testing.assert_allclose(cloud.xyz, xyz, atol=1e-9)
    assert cloud.frame is None


def test_las_withheld_points_are_left_out(tmp_path: Path) -> None:
    cloud = read_cloud(written(tmp_path, "a.las", las(XYZ, withheld=[0, 1, 0])))
    np.testing.assert_allclose(cloud.xyz, XYZ[[0, 2]])
    assert [(entry.source, entry.reason, entry.count) for entry in cloud.left_out] == [
        ("a.las", "points marked as withheld", 1)
    ]


PLACE = MapFrame("utm", (456000.0, 5427000.0, 0.0), 32)
LOCAL_XYZ = np.array([[10.0, 20.0, 100.0], [900.0, -30.5, 110.25]])


@pytest.mark.parametrize("epsg", [32632, 25832, 4326, 3857, "EPSG:25832+7837", "EPSG:2154"])
def test_las_knows_its_place(tmp_path: Path, epsg: int | str) -> None:
    """The same points in UTM of two datums, geographic, Mercator, compound and Lambert coordinates."""
    from pyproj import Transformer

    llh = llh_from_map(PLACE, LOCAL_XYZ)
    crs = CRS.from_user_input(epsg)
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    x, y = Transformer.from_crs("EPSG:4326", horizontal, always_xy=True).transform(*np.degrees(llh[:, 1::-1]).T)
    path = written(tmp_path, "a.las", las(np.stack((x, y, LOCAL_XYZ[:, 2]), axis=1), epsg))
    own = read_cloud(path)
    assert own.frame is not None
    assert (own.frame.kind, own.frame.zone) == ("utm", 32)
    assert np.abs(own.xyz[:, :2]).max() < 2000
    np.testing.assert_allclose(llh_from_map(own.frame, own.xyz)[:, :2], llh[:, :2], atol=3e-9)  # 2 cm
    for frame in (PLACE, MapFrame("enu", (49.0, 8.4, 0.0))):
        found = read_cloud(path, frame)
        assert found.frame == frame
        np.testing.assert_allclose(found.xyz, map_from_llh(frame, llh), atol=0.03)


def test_las_in_feet(tmp_path: Path) -> None:
    """NAD83 / Pennsylvania South in US feet: heights are feet as well."""
    path = written(tmp_path, "a.las", las([[1340000.0, 410000.0, 1000.0]], 2272))
    assert read_cloud(path).xyz[0, 2] == pytest.approx(1000.0 * 1200 / 3937, abs=1e-6)


def test_las_of_another_place_than_the_map(tmp_path: Path) -> None:
    path = written(tmp_path, "a.las", las([[456010.0, 5427020.0, 100.0]], 32632))
    with pytest.raises(EgolocError, match=str(path)):
        read_cloud(path, MapFrame("utm", zone=17))


@pytest.mark.parametrize("format", [0, 1, 3, 6, 7, 8])
@pytest.mark.parametrize("extra", [False, True])
def test_laz_of_every_format_and_its_claims(tmp_path: Path, format: int, extra: bool) -> None:
    """Several chunks come back; a layer, a chunk or a table that claims too much is refused before it is read."""
    header = laspy.LasHeader(point_format=format, version="1.4")
    header.scales = np.array([1e-3] * 3)
    if extra:
        header.add_extra_dim(laspy.ExtraBytesParams("quality", np.uint16))
    made = laspy.LasData(header)
    xyz = np.random.default_rng(1).normal(size=(50_010, 3)).round(3)
    made.x, made.y, made.z = xyz.T
    stream = BytesIO()
    made.write(stream, do_compress=True)
    data = stream.getvalue()
    np.testing.assert_allclose(read_cloud(written(tmp_path, "a.laz", data)).xyz, xyz, atol=1e-9)
    at = int.from_bytes(data[96:100], "little")
    table = int.from_bytes(data[at : at + 8], "little")
    many = data[: table + 4] + (1 << 31).to_bytes(4, "little") + data[table + 8 :]
    refused(written(tmp_path, "a.laz", many), "chunk table: 2147483648 chunks for 50010 points")
    refused(written(tmp_path, "a.laz", data[:at] + bytes(8) + data[at + 8 :]), "chunk table: expected it in the file's")
    refused(written(tmp_path, "a.laz", data[: at + 500]), "chunk table: expected it in the file's")
    if format >= 6:
        layer = at + 8 + header.point_format.size + 4
        for k in range(9):
            spoiled = data[: layer + 4 * k] + (1 << 31).to_bytes(4, "little") + data[layer + 4 * k + 4 :]
            refused(written(tmp_path, "a.laz", spoiled), "chunk 0: its layers claim more than its")


def test_las_headers_that_cannot_be(tmp_path: Path) -> None:
    data = bytearray(las(XYZ))
    data[247:255] = (10**12).to_bytes(8, "little")
    refused(written(tmp_path, "a.las", bytes(data)), "number of points: 1000000000000 points take")
    data[247:255] = (4).to_bytes(8, "little")
    refused(
        written(tmp_path, "a.las", bytes(data)), "number of points: the header claims 120 bytes of points, the file has"
    )
    data[247:255] = (3).to_bytes(8, "little")
    data[131:139] = struct.pack("<d", np.nan)
    refused(written(tmp_path, "a.las", bytes(data)), "scales: expected finite numbers")
    data[131:139] = struct.pack("<d", 1e-3)
    data[100:104] = (10**9).to_bytes(4, "little")
    refused(written(tmp_path, "a.las", bytes(data)), "number of variable length records: 1000000000 do not fit into")
    data[100:104] = bytes(4)
    data[243:247] = (10**9).to_bytes(4, "little")
    refused(written(tmp_path, "a.las", bytes(data)), "number of extended variable length records: 1000000000 do not")
    refused(written(tmp_path, "a.las", b"LASF"), "expected a LAS or LAZ file")
    refused(written(tmp_path, "a.laz", b"no las"), "expected a LAS or LAZ file")


# numpy


@quick
@given(xyz=CLOUDS, kind=st.sampled_from(["f4", "f8", "i4"]), name=st.sampled_from(["xyz", "points", "x y z", "npy"]))
def test_arrays_come_back(tmp_path: Path, xyz: Any, kind: str, name: str) -> None:
    array = np.asfortranarray(xyz.astype(kind))
    path = tmp_path / ("a.npy" if name == "npy" else "a.npz")
    if name == "npy":
        np.save(path, array)
    elif name == "x y z":
        np.savez_compressed(path, **{axis: array[:, k] for k, axis in enumerate("xyz")})
    else:
        np.savez(path, **{name: array, "other": np.array("text")})
    np.testing.assert_array_equal(read_cloud(path).xyz, array)


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"xyz": np.zeros((3, 4))}, r"xyz: expected shape \(N, 3\), got \(3, 4\)"),
        ({"points": np.zeros(3)}, r"points: expected shape \(N, 3\), got \(3,\)"),
        ({"xyz": np.zeros((1, 3), complex)}, "xyz: expected numbers, got complex128"),
        ({"xyz": np.array([["a"] * 3])}, "xyz: expected numbers"),
        ({"xyz": np.array([[None] * 3])}, "xyz: expected numbers, got object"),
        ({"x": np.zeros(3), "y": np.zeros(3)}, "z: expected arrays xyz, points, or x, y, z, got x, y"),
        ({"x": np.zeros(3), "y": np.zeros(3), "z": np.zeros(2)}, "x, y, z: expected one length, got 3, 3, 2"),
        ({"xyz": np.full((1, 3), 3e7)}, "x, y, z: expected metres, at most 2e"),
    ],
)
def test_arrays_that_are_no_points(tmp_path: Path, arrays: dict[str, Any], told: str) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    refused(tmp_path / "a.npz", told)


def test_an_array_that_claims_too_much(tmp_path: Path) -> None:
    stream = BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    refused(written(tmp_path, "a.npy", stream.getvalue()), "array: 1000000000000 points take")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("xyz.npy", stream.getvalue())
    refused(tmp_path / "a.npz", "xyz: 1000000000000 points take")
    np.save(tmp_path / "b.npy", np.zeros((5, 3)))
    refused(written(tmp_path, "b.npy", (tmp_path / "b.npy").read_bytes()[:-1]), "expected numpy arrays")


# All


@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.pcd", "c.pcd", "t.pcd", "a.ply", "t.ply", "a.npz", "a.npy"])
def test_damaged_anywhere_is_points_or_one_line(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(5)
    xyz = rng.normal(size=(40, 3)).round(3)
    buffer = BytesIO()
    np.savez(buffer, xyz=xyz)
    plain = BytesIO()
    np.save(plain, xyz)
    data = {
        "a.las": las(xyz, 32632), "a.laz": las(xyz, 32632, compress=True), "a.pcd": pcd(points(xyz), "binary"),
        "c.pcd": pcd(points(xyz), "binary_compressed"), "t.pcd": pcd(points(xyz), "ascii"),
        "a.ply": ply(points(xyz), "binary_little_endian"), "t.ply": ply(points(xyz), "ascii"),
        "a.npz": buffer.getvalue(), "a.npy": plain.getvalue(),
    }[name]  # fmt: skip
    failed = 0
    for k in range(150):
        spoiled = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            spoiled[rng.integers(min(len(data), 600 if k % 2 else len(data)))] = rng.integers(256)
        if k % 5 == 0:
            del spoiled[rng.integers(len(data)) :]
        path = written(tmp_path, name, bytes(spoiled))
        told = ""
        try:
            assert np.isfinite(read_cloud(path).xyz).all()
        except EgolocError as error:
            failed, told = failed + 1, str(error)
        assert not told or (str(path) in told and "\n" not in told)
    assert failed > 20


def test_files_that_are_no_clouds(tmp_path: Path) -> None:
    refused(written(tmp_path, "a.xyz", b""), r"expected a point cloud ending in .las, .laz, .ply, .pcd, .npz, .npy")
    refused(tmp_path / "absent.ply", "no such file")
    (tmp_path / "a.pcd").mkdir()
    refused(tmp_path / "a.pcd", "a folder, expected a file")
    refused(written(tmp_path, "empty.ply", b""), "the file is empty")
    with pytest.raises(EgolocError, match="cut the file into tiles"):
        check_room(tmp_path, "points", 10**12)
