"""Clouds as numpy arrays, and arrays that are none."""

import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors.clouds import read_cloud
from tests.sensors.clouds.made_clouds import CLOUDS, quick, refused, written


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
