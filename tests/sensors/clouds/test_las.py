"""LAS and LAZ files: coordinates, places on the earth, and claims that cannot be."""

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pyproj import CRS

from sensors.clouds import read_cloud
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, map_from_llh
from tests.sensors.clouds.made_clouds import (
    XYZ,
    las,
    quick,
    refused,
    written,
)


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
