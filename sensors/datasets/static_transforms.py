"""/tf_static: where sensor frames sit on a vehicle's base frame."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.rotation import matrix_from_q

Floats = NDArray[np.float64]
StaticTransforms = dict[str, tuple[str, Floats, Floats]]
"""child frame -> parent frame, R_parent_child (3, 3), p_parent (3,) m."""

BASE_FRAMES = ("base_link", "base_footprint", "body", "vehicle")
"""Frames that may be the body, in order of preference; x forward, y left, z up (REP 103)."""


def read_static(message: Any, found: StaticTransforms) -> None:
    """Add the transforms of one tf2_msgs/TFMessage."""
    for stamped in message.transforms:
        q, p = stamped.transform.rotation, stamped.transform.translation
        norm = np.linalg.norm([q.x, q.y, q.z, q.w])
        if np.isfinite(norm) and norm > 0.5:
            R = matrix_from_q([[q.x, q.y, q.z, q.w]])[0]
            parent = stamped.header.frame_id.lstrip("/")
            found[stamped.child_frame_id.lstrip("/")] = (parent, R, np.array([p.x, p.y, p.z]))


def base_from(found: StaticTransforms, frame: str) -> tuple[Floats, Floats] | None:
    """R_base_frame and p_base of a frame's origin, None where no chain leads to a base frame."""
    R, p = np.eye(3), np.zeros(3)
    for _ in range(len(found) + 1):
        if frame in BASE_FRAMES:
            return R, p
        if frame not in found:
            return None
        frame, R_parent, p_parent = found[frame]
        R, p = R_parent @ R, R_parent @ p + p_parent
    return None
