"""Time: int64 nanoseconds of Unix UTC; GPS time through the leap-second table."""

import numpy as np
from numpy.typing import NDArray

NS_PER_S = 1_000_000_000
GPS_EPOCH_NS = 315_964_800 * NS_PER_S
"""1980-01-06T00:00:00 UTC."""
WEEK_NS = 7 * 86_400 * NS_PER_S

_LEAP_DATES = (
    "1981-07-01 1982-07-01 1983-07-01 1985-07-01 1988-01-01 1990-01-01 1991-01-01 1992-07-01 1993-07-01 "
    "1994-07-01 1996-01-01 1997-07-01 1999-01-01 2006-01-01 2009-01-01 2012-07-01 2015-07-01 2017-01-01"
)
_LEAPS_NS = np.array(_LEAP_DATES.split(), "datetime64[ns]").astype(np.int64)
"""UTC instants after which GPS time runs one more second ahead (IERS Bulletin C; none announced since 2017)."""


def utc_from_gps(gps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Unix UTC nanoseconds of GPS time given as nanoseconds since 1980-01-06 (no leap seconds)."""
    unix = np.asarray(gps_ns, np.int64) + GPS_EPOCH_NS
    steps = _LEAPS_NS + np.arange(1, len(_LEAPS_NS) + 1) * NS_PER_S
    result: NDArray[np.int64] = unix - np.searchsorted(steps, unix, side="right") * NS_PER_S
    return result


def utc_from_gps_week(week: NDArray[np.int64], seconds_of_week: NDArray[np.float64]) -> NDArray[np.int64]:
    """Unix UTC nanoseconds of GPS week and seconds of week; rounded to a microsecond (a double holds no more)."""
    micros = np.rint(np.asarray(seconds_of_week, np.float64) * 1e6).astype(np.int64)
    return utc_from_gps(np.asarray(week, np.int64) * WEEK_NS + micros * 1000)


def seconds(t_ns: NDArray[np.int64], origin_ns: int) -> NDArray[np.float64]:
    """Seconds since an origin, as float64 (exact to a nanosecond over 100 days)."""
    return np.asarray((np.asarray(t_ns, np.int64) - origin_ns) * 1e-9, np.float64)
