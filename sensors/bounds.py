"""Checked kinds of numbers in configs: a TOML or JSON value outside (or NaN) is refused with its path.

Every kind is bounded on both sides, so that infinity is refused too.
"""

from typing import Annotated

import msgspec

from sensors.errors import EgolocError

Finite = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
NonNegative = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
PositiveInt = Annotated[int, msgspec.Meta(gt=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Latitude = Annotated[float, msgspec.Meta(ge=-84.0, le=84.0)]
Longitude = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
RateHz = Annotated[float, msgspec.Meta(ge=0.1, le=1000.0)]
"""A rate that lays out rows: a log of a day must fit into memory."""
Lever = Annotated[float, msgspec.Meta(ge=-1000.0, le=1000.0)]
"""One axis of a lever arm, m."""
Delay = Annotated[float, msgspec.Meta(ge=-60.0, le=60.0)]
"""A sensor's delay, s."""


def check_order(config: msgspec.Struct, low: str, high: str) -> None:
    """Raise unless the first field is no larger than the second."""
    if getattr(config, low) > getattr(config, high):
        raise EgolocError(f"{low}: expected at most {high} ({getattr(config, high):g}), got {getattr(config, low):g}")
