"""A trajectory written as CSV with named columns, to the last bit; ``sensors.datasets.trajectory_file`` reads it."""

import math
from pathlib import Path

import numpy as np

from sensors.records import Trajectory
from sensors.whole_file import whole_file

COLUMNS = ("t_ns", "x", "y", "z", "qx", "qy", "qz", "qw", "sigma_m", "sigma_yaw")
"""Map coordinates m, body in map axes, standard deviations m and rad; an empty cell is not known."""


def write_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory, whole or not at all. Raises EgolocError where it cannot be written."""
    values = np.hstack((trajectory.p_map, trajectory.q_map_body, trajectory.sigma)).tolist()
    rows = (
        ",".join((str(t_ns), *("" if math.isnan(cell) else repr(cell) for cell in row)))
        for t_ns, row in zip(trajectory.t_ns.tolist(), values, strict=True)
    )
    with whole_file(path) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text("\n".join((",".join(COLUMNS), *rows, "")), encoding="utf-8")
