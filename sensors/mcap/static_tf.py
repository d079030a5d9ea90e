"""/tf_static (tf2_msgs/TFMessage): where sensors sit on the vehicle, one transform a message or many."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.datasets.static_transforms import StaticTransforms
from sensors.mcap.cdr import MalformedMessageError
from sensors.mcap.message_bytes import MessageReader, MessageWriter
from sensors.rotation import matrix_from_q, q_from_matrix

Floats = NDArray[np.float64]

TRANSFORMS = "tf2_msgs/TFMessage"
TOPIC = "/tf_static"
BODY = "base_link"
"""The body's frame in our logs."""
_MAX_TRANSFORMS = 4096


def encode_transforms(T_body_sensor: Mapping[str, Floats], t_ns: int) -> bytes:
    """The message of frames on the body: frame -> (4, 4)."""
    out = MessageWriter()
    out.number("I", len(T_body_sensor))
    for frame, T in T_body_sensor.items():
        sec, nanosec = divmod(t_ns, NS_PER_S)
        out.number("i", sec)
        out.number("I", nanosec)
        out.text(BODY)
        out.text(frame)
        out.doubles(*T[:3, 3])
        out.doubles(*q_from_matrix(T[:3, :3]))
    return bytes(out.data)


def decode_transforms(data: memoryview, found: StaticTransforms) -> None:
    """Add a message's transforms to those that were found; one without a rotation is passed over.

    MalformedMessageError where the message is shorter than it says; what was read until then stays.
    """
    message = MessageReader(data)
    count = message.number("I")
    if count > _MAX_TRANSFORMS:
        raise MalformedMessageError(f"more than {_MAX_TRANSFORMS} transforms")
    for _ in range(count):
        message.number("i")
        message.number("I")
        parent, child = message.text().lstrip("/"), message.text().lstrip("/")
        p, q = np.array(message.doubles(3)), np.array(message.doubles(4))
        if np.isfinite(p).all() and np.isfinite(q).all() and np.linalg.norm(q) > 0.5:
            found[child] = (parent, matrix_from_q(q[None])[0], p)
