"""When each point of a cloud was measured: what the drivers' time fields mean.

| field | type | meaning | who |
|---|---|---|---|
| t, offset_time, time_stamp | uint32 | ns since the header's stamp | Ouster, Livox's own points, Autoware |
| time, time_offset | float32 | s from the header's stamp, also negative | Velodyne |
| timestamp | float64 | s since 1970 | Hesai, Robosense |
| timestamp | float64 or uint64 | ns since 1970 | livox_ros_driver2 |

Any of the names may come with any of the types; how large the numbers are tells relative from absolute and s from ns.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError

TIME_FIELDS = ("t", "time", "timestamp", "time_offset", "offset_time", "time_stamp")
"""Names of fields that tell a point's time; of several the first."""
ABSOLUTE_NS = 1e17
"""Numbers from here on are ns since 1970 (1973)."""
ABSOLUTE_S = 1e8
"""Floats from here on (and below ABSOLUTE_NS) are s since 1970."""
LONGEST_S = 2.0
"""No turn takes longer; a point further from its stamp has a time in another unit, or on another clock."""


def offsets(name: str, values: NDArray[Any], stamp_ns: int) -> NDArray[np.int32]:
    """(N,) int32 ns from the stamp of the values (N,) of a time field; EgolocError where they can be no such times."""
    if not len(values):
        return np.zeros(0, np.int32)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise EgolocError(f"field {name}: expected finite times, got NaN or Inf")
    offset_ns = _from_integers(values, stamp_ns) if values.dtype.kind in "iu" else _from_floats(values, stamp_ns)
    furthest = float(np.abs(offset_ns).max())
    if furthest > LONGEST_S * NS_PER_S:
        raise EgolocError(
            f"field {name}: expected times within {LONGEST_S:g} s of the stamp (s or, as integers, ns; relative or "
            f"since 1970), got {values[np.argmax(np.abs(offset_ns))]:.10g} with stamp {stamp_ns / NS_PER_S:.3f} s"
        )
    return offset_ns.astype(np.int32)


def _from_integers(values: NDArray[Any], stamp_ns: int) -> NDArray[Any]:
    """Nanoseconds; of unsigned 64 bits the difference to the stamp is exact as well."""
    if values.max() >= ABSOLUTE_NS:
        return values.astype(np.int64) - stamp_ns
    return values.astype(np.float64)


def _from_floats(values: NDArray[Any], stamp_ns: int) -> NDArray[Any]:
    """Nanoseconds of seconds; of nanoseconds where they are that large."""
    numbers = values.astype(np.float64)
    largest = np.abs(numbers).max()
    if largest >= ABSOLUTE_NS:
        return numbers - float(stamp_ns)
    if largest < ABSOLUTE_S:
        return np.rint(numbers * NS_PER_S)
    stamp_s, stamp_part = divmod(stamp_ns, NS_PER_S)
    return np.rint((numbers - stamp_s) * NS_PER_S) - stamp_part  # the difference of two such seconds is exact
