"""Which topics of a log are LiDARs, and where each sensor sits on the vehicle."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.datasets.static_transforms import StaticTransforms, base_from
from sensors.errors import EgolocError
from sensors.mcap.assembly import unsealed
from sensors.mcap.cdr import MalformedMessageError, short_name
from sensors.mcap.container import ChannelRecord, Definitions, SchemaRecord
from sensors.mcap.frame_writer import SweepFacts, metadata_name
from sensors.mcap.point_cloud import POINT_CLOUD
from sensors.mcap.sections import Container, open_container
from sensors.mcap.single_messages import MessageWalk
from sensors.mcap.static_tf import TOPIC, TRANSFORMS, decode_transforms
from sensors.mcap.topics import LIDAR

Floats = NDArray[np.float64]

WORLD_FRAMES = frozenset({"map", "world", "odom", "earth"})
"""frame_id of clouds that somebody put together in the world: no LiDAR saw them at one moment."""


def names_of(chosen: str | Sequence[str] | None, sensor: str = LIDAR) -> tuple[str, ...]:
    """Topics of a choice: one, several, or several between commas; empty: whatever the log has."""
    if chosen is None:
        return ()
    given = chosen.split(",") if isinstance(chosen, str) else chosen
    names = tuple(name.strip() for name in given)
    if not names or not all(names) or len(set(names)) < len(names):
        raise EgolocError(f"topics.{sensor}: expected topics, with commas between several, got {chosen!r}")
    return names


def is_cloud(names: tuple[str, ...]) -> Callable[[ChannelRecord, SchemaRecord], bool]:
    """Whether a channel is a LiDAR's: of the named topics, or of any of the schema."""

    def wanted(channel: ChannelRecord, schema: SchemaRecord) -> bool:
        return short_name(schema.name) == POINT_CLOUD and (not names or channel.topic in names)

    return wanted


def check_names(
    path: Path,
    names: tuple[str, ...],
    definitions: Definitions,
    sensor: str = LIDAR,
    expected: Collection[str] = (POINT_CLOUD,),
) -> None:
    """EgolocError where a named topic is not in the log, or has none of the schemas of its sensor."""
    schemas = {c.topic: definitions.schemas.get(c.schema_id) for c in definitions.channels.values()}
    for name in names:
        if name not in schemas:
            known = ", ".join(sorted(schemas)[:20]) or "none"
            raise EgolocError(f"{path}: topics.{sensor}: no topic {name}; the log has {known}")
        schema = schemas[name]
        if schema is None or short_name(schema.name) not in expected:
            found, told = schema.name if schema else "none", " or ".join(sorted(expected))
            raise EgolocError(f"{path}: topics.{sensor}: {name} has schema {found}, expected {told}")


def check_encoding(path: Path, channel: ChannelRecord) -> None:
    """EgolocError where a topic's messages are not those of ROS 2."""
    if channel.encoding != "cdr":
        raise EgolocError(f"{path}: {channel.topic}: expected cdr messages, got {channel.encoding}")


def is_compensated(source: Container, topic: str) -> bool | None:
    """What our metadata record of a topic says; None where there is none. EgolocError where it is damaged."""
    record = source.metadata.get(metadata_name(topic))
    if record is None:
        return None
    text = unsealed(record)
    if text is None:
        raise EgolocError(f"{source.path}: metadata {metadata_name(topic)} fails its checksum")
    try:
        return msgspec.json.decode(text, type=SweepFacts).compensated
    except msgspec.MsgspecError as error:
        raise EgolocError(f"{source.path}: metadata {metadata_name(topic)}: {error}") from None


def static_transforms(path: Path) -> StaticTransforms:
    """Every transform of the topics /tf_static of a log; of two for one frame the later.

    A file without a summary is walked for it to its end, for recorders may repeat the topic anywhere.
    """
    found: StaticTransforms = {}
    walk = MessageWalk(open_container(path), _is_static)
    for message in walk.messages():
        try:
            decode_transforms(message.data, found)
        except MalformedMessageError:
            continue  # a LiDAR that it concerned will be told to have no place
    return found


def _is_static(channel: ChannelRecord, schema: SchemaRecord) -> bool:
    return channel.topic.endswith(TOPIC) and short_name(schema.name) == TRANSFORMS and channel.encoding == "cdr"


def pose_of(found: StaticTransforms, frame: str) -> Floats | None:
    """(4, 4) T_body_lidar of a cloud's frame; None where no chain of transforms leads to a base frame."""
    mounted = base_from(found, frame)
    if mounted is None:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = mounted
    return T
