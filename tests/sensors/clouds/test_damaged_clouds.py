"""Damage anywhere in a cloud of any format, and files that are no clouds."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from sensors.clouds import read_cloud
from sensors.clouds.cloud import check_room
from sensors.errors import EgolocError
from tests.sensors.clouds.made_clouds import las, pcd, ply, points, refused, written


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
