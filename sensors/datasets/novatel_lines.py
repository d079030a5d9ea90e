"""NovAtel OEM7 ASCII logs as lines: header, CRC, body.

Source: OEM7 Commands and Logs Reference Manual, 1.1 (ASCII), 1.4 (short headers), 1.10 (32-bit CRC).

``#NAME,port,sequence,idle,time status,week,seconds,receiver status,reserved,version;body*crc`` (long header) or
``%NAME,week,seconds;body*crc`` (short header).
"""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

GOOD_TIME = {
    "FINE",
    "FINESTEERING",
    "FINEADJUSTING",
    "COARSE",
    "COARSESTEERING",
    "COARSEADJUSTING",
    "FREEWHEELING",
    "SATTIME",
}
"""Time statuses whose week and seconds are GPS time."""


@dataclass(slots=True)
class Lines:
    """Bodies by log name with week and seconds of their header; what was left out by reason."""

    bodies: dict[str, list[tuple[int, float, list[str]]]] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)

    def reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1


def crc32(data: bytes) -> int:
    """NovAtel's CRC: polynomial 0xEDB88320 reflected, start 0, no final inversion; over all between # or % and *."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def parse(raw: Iterable[bytes], least_fields: Mapping[str, int]) -> Lines:
    """Sort the lines of the wanted logs (name -> least number of fields in the body); others are skipped.

    A line that fails its CRC, is cut or has no GPS time is counted in ``rejected``.
    """
    lines = Lines()
    for line in raw:
        start = max(line.rfind(b"#"), line.rfind(b"%"))
        if start < 0:
            continue
        text = line[start:].strip()
        if text[1 : text.find(b",")].decode("ascii", "replace") in least_fields:
            _sort(lines, text, least_fields)
    return lines


def _sort(lines: Lines, text: bytes, least_fields: Mapping[str, int]) -> None:
    content, star, given = text[1:].rpartition(b"*")
    if not star or len(given) != 8:
        return lines.reject("cut line")
    try:
        matches = crc32(content) == int(given, 16)
    except ValueError:
        matches = False
    if not matches:
        return lines.reject("CRC does not match")
    header, semicolon, body = content.decode("ascii", "replace").partition(";")
    head, fields = header.split(","), [value.strip('"') for value in body.split(",")]
    name = head[0]
    long = text.startswith(b"#")
    if not semicolon or len(head) < (7 if long else 3) or len(fields) < least_fields[name]:
        return lines.reject(f"{name}: too few fields")
    if long and head[4] not in GOOD_TIME:
        return lines.reject("no GPS time yet")
    try:
        week, seconds = (int(head[5]), float(head[6])) if long else (int(head[1]), float(head[2]))
    except ValueError:
        return lines.reject(f"{name}: time is not a number")
    lines.bodies.setdefault(name, []).append((week, seconds, fields))
    return None
