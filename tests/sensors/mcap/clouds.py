"""Makes frames, and PointCloud2 and TFMessage values as other recorders write them."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors.frames import Frame, Sweep
from tests.sensors.mcap.messages import START_NS, header, vector

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def pose(seed: int) -> NDArray[np.float64]:
    """(4, 4) some rigid transform."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


def sweep(count: int, seed: int = 0, *, compensated: bool = False, T: NDArray[np.float64] | None = None) -> Sweep:
    rng = np.random.default_rng(seed)
    return Sweep(
        rng.normal(scale=30.0, size=(count, 3)).astype(np.float32),
        pose(7) if T is None else T,
        rng.integers(-(10**8), 10**8, count).astype(np.int32),
        rng.uniform(0, 255, count).astype(np.float32),
        rng.integers(0, 64, count).astype(np.int16),
        compensated,
    )


def frames(count: int, points: int = 100, lidars: int = 1, compensated: bool = False) -> list[Frame]:
    """Frames 100 ms apart that arrive 30 ms later."""
    stamps = [START_NS + k * 100_000_000 for k in range(count)]
    return [
        Frame(
            t,
            t + 30_000_000,
            tuple(sweep(points + i, 10 * k + i, compensated=compensated, T=pose(i)) for i in range(lidars)),
        )
        for k, t in enumerate(stamps)
    ]


def cloud_value(
    points: NDArray[np.void], t_ns: int, frame: str = "lidar", rows: int = 1, pad: int = 0, **other: Any
) -> dict[str, Any]:
    """A PointCloud2 of a structured array: its fields where its dtype has them; pad: bytes behind each row."""
    assert points.dtype.fields is not None
    fields = [
        {"name": name, "offset": offset, "datatype": CODES[kind.base.str[1:]], "count": int(np.prod(kind.shape))}
        for name, (kind, offset, *_) in points.dtype.fields.items()
    ]
    table = points.reshape(rows, -1)
    data = b"".join(row.tobytes() + bytes(pad) for row in table)
    return {
        "header": header(t_ns, frame),
        "height": rows,
        "width": table.shape[1],
        "fields": fields,
        "is_bigendian": False,
        "point_step": points.dtype.itemsize,
        "row_step": table.shape[1] * points.dtype.itemsize + pad,
        "data": data,
        "is_dense": True,
    } | other


def points_of(
    xyz: Sequence[Sequence[float]] | NDArray[Any], **columns: tuple[str, Iterable[float]]
) -> NDArray[np.void]:
    """Points with x, y, z as float32 and further fields: name=(type, values)."""
    xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
    made = np.zeros(len(xyz), [(a, "<f4") for a in "xyz"] + [(n, f"<{kind}") for n, (kind, _) in columns.items()])
    for k, axis in enumerate("xyz"):
        made[axis] = xyz[:, k]
    for name, (_, values) in columns.items():
        made[name] = list(values)
    return made


def transform_value(parent: str, child: str, T: NDArray[np.float64]) -> dict[str, Any]:
    q = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {
        "header": header(0, parent),
        "child_frame_id": child,
        "transform": {"translation": vector(T[:3, 3]), "rotation": vector(q, "xyzw")},
    }
