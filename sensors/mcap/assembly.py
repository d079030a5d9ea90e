"""What a log carries besides its rows: vehicle and map frame, and what of it could not be used.

What messages cannot say (vehicle, map frame) travels in a metadata record named ``egoloc``: JSON and its CRC-32.
"""

import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import msgspec

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.mcap.cdr import short_name
from sensors.mcap.gather import Gatherer
from sensors.mcap.sections import Container
from sensors.mcap.topics import Roles, feeds, is_plain_text
from sensors.records import LeftOut
from sensors.vehicle import Vehicle

METADATA = "egoloc"


class Facts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The metadata record's JSON."""

    vehicle: Vehicle = Vehicle()
    map_frame: MapFrame | None = None


class News:
    """Tells what was left out since it was asked last, of counts that only grow."""

    def __init__(self) -> None:
        self._told: Counter[tuple[str, str]] = Counter()

    def since(self, entries: Iterable[LeftOut]) -> Iterator[LeftOut]:
        """The growth of each count."""
        for entry in entries:
            grown = entry.count - self._told[entry.source, entry.reason]
            if grown:
                self._told[entry.source, entry.reason] = entry.count
                yield LeftOut(entry.source, entry.reason, grown)


def unused(gatherer: Gatherer, roles: Roles) -> list[LeftOut]:
    """Topics of a sensor's schema that feed none, and chosen ones without messages."""
    reasons = dict(roles.ignored)
    reasons |= {topic.name: "no messages" for topic in roles.sensors.values() if topic.count == 0}
    return [
        LeftOut(topic.name, reasons[topic.name], topic.count)
        for topic in gatherer.topics
        if topic.name in reasons and not topic.unreadable and not is_plain_text(topic)
        if feeds(short_name(topic.schema.name))
    ]


def damage(source: Container, gatherer: Gatherer, *, at_end: bool) -> list[LeftOut]:
    """What of the file itself could not be read so far, and which messages of its topics."""
    name = source.path.name
    rows = [LeftOut(name, reason, count) for reason, count in source.damage.items()]
    if at_end and source.truncated:
        rows.append(LeftOut(name, "the file is truncated: it has no end marker", 1))
    if source.bytes_lost:
        rows.append(LeftOut(name, "bytes that belong to no whole record", source.bytes_lost))
    if gatherer.unknown:
        rows.append(LeftOut(name, "messages of a channel that is not defined", gatherer.unknown))
    if gatherer.outside_chunks:
        rows.append(LeftOut(name, "messages outside the chunks, which no checksum covers", gatherer.outside_chunks))
    for topic in gatherer.topics:
        rows += [LeftOut(topic.name, reason, count) for reason, count in topic.unreadable.items()]
    return rows


def sealed(content: msgspec.Struct) -> dict[str, str]:
    """A metadata record: JSON with its checksum."""
    text = msgspec.json.encode(content)
    return {"json": text.decode(), "crc32": f"{zlib.crc32(text):08x}"}


def unsealed(record: Mapping[str, str]) -> bytes | None:
    """The JSON of a metadata record; None where it fails its checksum."""
    text = record.get("json", "").encode()
    return text if record.get("crc32", "") == f"{zlib.crc32(text):08x}" else None


def read_facts(source: Container) -> tuple[Facts, tuple[LeftOut, ...]]:
    """Vehicle and map frame; the defaults where the log has none or they fail their checksum."""
    record = source.metadata.get(METADATA)
    if record is None:
        return Facts(), ()
    text = unsealed(record)
    if text is None:
        return Facts(), (LeftOut(source.path.name, f"metadata {METADATA} fails its checksum", 1),)
    try:
        return msgspec.json.decode(text, type=Facts), ()
    except (msgspec.MsgspecError, EgolocError) as error:
        raise EgolocError(f"{source.path}: metadata {METADATA}: {error}") from None
