"""The smoothed states of a run (``egoloc replay --smooth``) as a reference for other replays."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.datasets.map_trajectory import trajectory_from_llh
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, rotation_map_enu
from sensors.records import Trajectory
from sensors.rotation import multiply, q_from_matrix, q_from_rpy, rotate

Floats = NDArray[np.float64]

RUN_KEY = b"egoloc"
"""Of the Parquet metadata that says what the columns do not."""
_COLUMNS = ("t_ns", "x", "y", "z", "roll", "pitch", "yaw", "pose_cov")


class _Said(msgspec.Struct):
    map_frame: MapFrame


def is_parquet(path: Path) -> bool:
    """Whether a file begins as Parquet does."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def read_run_trajectory(path: Path, map_frame: MapFrame | None, arm: ArrayLike) -> tuple[Trajectory, MapFrame]:
    """A body point (3,) m of the smoothed states in map_frame, and that frame (None: the run's own).

    Its sigmas are those of the pose covariance: the worst horizontal direction, and yaw.
    """
    columns, own = _read(path)
    p_map = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    q = q_from_rpy(columns["roll"], columns["pitch"], columns["yaw"])
    known: NDArray[np.bool_] = np.isfinite(np.column_stack((p_map, q))).all(axis=1)
    if not known.any():
        raise EgolocError(f"{path}: no usable row of {len(known)}: expected smoothed states (see --states-hz)")
    t_ns, p_map, q = columns["t_ns"][known], p_map[known], q[known]
    p_map = p_map + rotate(q, np.asarray(arm, np.float64))
    sigma = _sigma(columns["pose_cov"][known])
    if map_frame is None or map_frame == own:
        return Trajectory(t_ns, t_ns, p_map, q, sigma), own
    llh = llh_from_map(own, p_map)
    q_enu_map = q_from_matrix(rotation_map_enu(own, llh)[0].transpose(0, 2, 1))
    q_enu_body = multiply(q_enu_map, q)
    return trajectory_from_llh(map_frame, t_ns, llh, q_enu_body, sigma), map_frame


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], MapFrame]:
    """The columns, pose_cov (N, 6, 6), and the map frame they are in."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            said = (file.schema_arrow.metadata or {}).get(RUN_KEY)
            missing = [name for name in _COLUMNS if name not in file.schema_arrow.names]
            if said is None or missing:
                what = f"without column {missing[0]}" if missing else "without a map frame in its metadata"
                raise EgolocError(
                    f"{path}: expected smoothed.parquet of a run (egoloc replay --smooth), got one {what}"
                )
            table = file.read(columns=list(_COLUMNS))
    except (pa.ArrowException, OSError) as error:
        raise EgolocError(f"{path}: expected a Parquet file: {str(error).splitlines()[0]}") from None
    try:
        frame = msgspec.json.decode(said, type=_Said).map_frame
    except msgspec.MsgspecError as error:
        raise EgolocError(f"{path}: metadata {RUN_KEY.decode()}: {error}") from None
    columns = {name: table[name].to_numpy() for name in _COLUMNS[:-1]}
    cov = table["pose_cov"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return columns | {"pose_cov": cov.reshape(-1, 6, 6)}, frame


def _sigma(cov: Floats) -> Floats:
    """(N, 2) m, rad."""
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    return np.sqrt(np.stack(((a + c) / 2 + np.hypot((a - c) / 2, b), cov[:, 5, 5]), axis=-1))
