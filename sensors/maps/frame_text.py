"""Map frames as a user writes them: ``utm:32N``, ``utm:32N:455000,5427000``, ``enu:48.99,8.40,110``."""

import re

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame

FORM = "utm:ZONE(N|S)[:EASTING,NORTHING[,HEIGHT]] or enu:LATITUDE,LONGITUDE[,HEIGHT] (deg, m)"
_UTM = re.compile(r"utm:(\d{1,2})([NS])(?::(.*))?", re.IGNORECASE)


def frame_of(text: str) -> MapFrame:
    """The frame. The numbers of a UTM one are the origin that is subtracted, m. Raises EgolocError where it is none."""
    utm = _UTM.fullmatch(text)
    if utm:
        origin = _numbers(text, utm[3], 2) if utm[3] else (0.0, 0.0, 0.0)
        return MapFrame("utm", origin, int(utm[1]), utm[2].upper() == "S")
    if not text.lower().startswith("enu:"):
        raise _wrong(text)
    return MapFrame("enu", _numbers(text, text[4:], 2))


def text_of(frame: MapFrame) -> str:
    """What ``frame_of`` reads."""
    numbers = ",".join(f"{number:.10g}" for number in frame.origin)
    return f"utm:{frame.zone}{'S' if frame.south else 'N'}:{numbers}" if frame.kind == "utm" else f"enu:{numbers}"


def _numbers(text: str, part: str, least: int) -> tuple[float, float, float]:
    """Three of them, the last 0 where it is missing."""
    try:
        numbers = [float(word) for word in part.split(",")]
    except ValueError:
        raise _wrong(text) from None
    if not least <= len(numbers) <= 3:
        raise _wrong(text)
    x, y, z = (*numbers, 0.0)[:3]
    return x, y, z


def _wrong(text: str) -> EgolocError:
    return EgolocError(f"map frame {text!r}: expected {FORM}")
