"""Checked kinds of numbers in the simulator's configs; a TOML value outside is refused with its path."""

from typing import Annotated

import msgspec

from sensors.errors import EgolocError

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Latitude = Annotated[float, msgspec.Meta(ge=-84.0, le=84.0)]
Longitude = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]


def check_order(config: msgspec.Struct, low: str, high: str) -> None:
    """Raise unless the first field is no larger than the second."""
    if getattr(config, low) > getattr(config, high):
        raise EgolocError(f"{low}: expected at most {high} ({getattr(config, high):g}), got {getattr(config, low):g}")
