"""Topics with a role -> Log: decoded records, the facts that a log carries, and what was left out of it.

What messages cannot say (vehicle, map frame) travels in a metadata record named ``egoloc``: JSON and its CRC-32.
"""

import zlib

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.mcap.cdr import short_name
from sensors.mcap.decode import DECODERS
from sensors.mcap.gather import Gatherer
from sensors.mcap.sections import Container
from sensors.mcap.topics import Roles, feeds
from sensors.records import LeftOut, Log
from sensors.vehicle import Vehicle

METADATA = "egoloc"


class Facts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The metadata record's JSON."""

    vehicle: Vehicle = Vehicle()
    map_frame: MapFrame | None = None


def assemble(source: Container, gatherer: Gatherer, roles: Roles) -> Log:
    """Decode the topics that have a sensor."""
    found, left_out = {}, list(damage(source, gatherer))
    for topic in gatherer.topics:
        left_out += [LeftOut(topic.name, reason, count) for reason, count in topic.unreadable.items()]
    with np.errstate(all="ignore"):
        for sensor, topic in roles.sensors.items():
            found[sensor], dropped = DECODERS[sensor](topic)
            left_out += [row for row in dropped if row not in left_out]
    left_out += _ignored(gatherer, roles)
    facts, problem = _facts(source)
    return Log(**found, vehicle=facts.vehicle, map_frame=facts.map_frame, left_out=(*left_out, *problem))


def _ignored(gatherer: Gatherer, roles: Roles) -> list[LeftOut]:
    """Topics of a sensor's schema that feed none, and chosen ones without messages."""
    reasons = dict(roles.ignored)
    reasons |= {topic.name: "no messages" for topic in roles.sensors.values() if topic.count == 0}
    return [
        LeftOut(topic.name, reasons[topic.name], topic.count)
        for topic in gatherer.topics
        if topic.name in reasons and not topic.unreadable and feeds(short_name(topic.schema.name))
    ]


def damage(source: Container, gatherer: Gatherer) -> list[LeftOut]:
    """What of the file itself could not be read."""
    name = source.path.name
    rows = [LeftOut(name, reason, count) for reason, count in source.damage.items()]
    if source.truncated:
        rows.append(LeftOut(name, "the file is truncated: it has no end marker", 1))
    if source.bytes_lost:
        rows.append(LeftOut(name, "bytes that belong to no whole record", source.bytes_lost))
    if gatherer.unknown:
        rows.append(LeftOut(name, "messages of a channel that is not defined", gatherer.unknown))
    if gatherer.outside_chunks:
        rows.append(LeftOut(name, "messages outside the chunks, which no checksum covers", gatherer.outside_chunks))
    return rows


def _facts(source: Container) -> tuple[Facts, tuple[LeftOut, ...]]:
    """Vehicle and map frame; the defaults where the log has none or they fail their checksum."""
    record = source.metadata.get(METADATA)
    if record is None:
        return Facts(), ()
    text = record.get("json", "").encode()
    if record.get("crc32", "") != f"{zlib.crc32(text):08x}":
        return Facts(), (LeftOut(source.path.name, f"metadata {METADATA} fails its checksum", 1),)
    try:
        return msgspec.json.decode(text, type=Facts), ()
    except (msgspec.MsgspecError, EgolocError) as error:
        raise EgolocError(f"{source.path}: metadata {METADATA}: {error}") from None
