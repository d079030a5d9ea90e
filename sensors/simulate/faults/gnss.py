"""Faults of GNSS: position, velocity and what the receiver claims of them."""

import numpy as np

from sensors.records import GnssStatus
from sensors.simulate.faults.fault import (
    Act,
    During,
    Fault,
    Floats,
    Rows,
    ahead,
    behind,
    burst,
    duplicated,
    every,
    late,
    lost,
    overtaken,
    repeated,
    restamped,
    spoilt,
    stuck,
    times,
)
from sensors.simulate.gnss import displaced

WRONG_SIGMAS = (0.01, 0.01, 0.018)
"""What a receiver claims of a wrong fix, m, ENU."""


def _both(act: Act) -> dict[str, Act]:
    return {"gnss": act, "gnss_velocity": act}


def _moved(rows: Rows, offset_enu: Floats) -> Rows:
    """Positions moved by (N, 3) m."""
    return rows.having(llh=displaced(rows.columns["llh"], offset_enu))


def _along(azimuth: float, metres: Floats) -> Floats:
    """(N, 3) ENU offsets of (N,) m in a direction, rad from east."""
    return np.stack((metres * np.cos(azimuth), metres * np.sin(azimuth), np.zeros(len(metres))), axis=-1)


def jumped(rows: Rows, during: During) -> Rows:
    """Positions are off in one direction."""
    return _moved(rows, _along(during.azimuth, np.full(len(rows.true_ns), during.size)))


def wrongly_fixed(rows: Rows, during: During) -> Rows:
    """As jumped, with the status and the sigma of a fixed solution."""
    cov = np.broadcast_to(np.diag(np.square(WRONG_SIGMAS)), rows.columns["cov_enu"].shape)
    status = np.full(len(rows.true_ns), GnssStatus.FIXED, np.int8)
    return jumped(rows, during).having(cov_enu=cov, status=status)


def _drifting(rows: Rows, during: During) -> Rows:
    return _moved(rows, _along(during.azimuth, during.size * during.since_s))


def _outlying(rows: Rows, during: During) -> Rows:
    """One position of five is off in a direction of its own."""
    azimuth = during.rng.uniform(-np.pi, np.pi, len(rows.true_ns))
    metres = np.where(during.number % 5 == 0, during.size, 0.0)
    return _moved(rows, np.stack((metres * np.cos(azimuth), metres * np.sin(azimuth), 0.0 * metres), axis=-1))


def _noisy(rows: Rows, during: During) -> Rows:
    return _moved(rows, during.size * during.rng.standard_normal((len(rows.true_ns), 3)))


def _biased_velocity(rows: Rows, during: During) -> Rows:
    offset = _along(during.azimuth, np.full(len(rows.true_ns), during.size))
    return rows.having(vel_enu=rows.columns["vel_enu"] + offset)


def _shrunk(rows: Rows, during: During) -> Rows:
    return rows.having(cov_enu=rows.columns["cov_enu"] / during.size)


def _without_numbers(rows: Rows, during: During) -> Rows:
    llh = rows.columns["llh"].copy()
    llh[every(during), :2] = np.nan
    return rows.having(llh=llh)


OUT = (2.0, 10.0, 60.0)
SILENT = (0.5, 2.0, 5.0)
SHORT = (1.0, 5.0, 20.0)

FAULTS = (
    Fault("gnss-jump", "positions are {} off, sigmas as before", {"gnss": jumped}, (1.0, 5.0, 50.0), (10.0,) * 3, "m"),
    Fault("gnss-drift", "positions drift off by {}", {"gnss": _drifting}, (0.03, 0.1, 0.3), (40.0,) * 3, "m/s"),
    Fault(
        "gnss-wrong-fix",
        "a fixed solution {} off that claims 1 cm",
        {"gnss": wrongly_fixed},
        (0.5, 1.5, 4.0),
        (30.0,) * 3,
        "m",
    ),
    Fault(
        "gnss-stuck",
        "position and velocity keep their values for {}",
        {"gnss": stuck("llh", "yaw"), "gnss_velocity": stuck("vel_enu")},
        None,
        SHORT,
    ),
    Fault("gnss-outliers", "one position of five is {} off", {"gnss": _outlying}, (2.0, 10.0, 100.0), unit="m"),
    Fault("gnss-noise", "white noise of {} that the sigma does not tell", {"gnss": _noisy}, (0.1, 0.5, 3.0), unit="m"),
    Fault("gnss-time-jump", "stamps run {} ahead", _both(ahead), (0.1, 0.5, 3.0), unit="s"),
    Fault("gnss-time-back", "stamps stay {} behind", _both(behind), (0.1, 0.5, 3.0), unit="s", back=True),
    Fault(
        "gnss-swapped",
        "every second message is {} late and overtaken; stamps are right",
        _both(overtaken),
        (0.15, 0.4, 0.9),
        unit="s",
    ),
    Fault("gnss-duplicates", "every message comes {}", _both(duplicated), (2.0, 5.0, 20.0), unit="times"),
    Fault(
        "gnss-repeated",
        "every message comes again {}, 1 ms apart by their stamps",
        _both(repeated),
        (1.0, 4.0, 9.0),
        unit="times",
    ),
    Fault("gnss-latency", "messages are {} late; stamps are right", _both(late), (0.1, 0.5, 2.0), unit="s"),
    Fault("gnss-burst", "silence for {}, then all at once; stamps are right", _both(burst), SILENT, unit="s"),
    Fault("gnss-restamped", "silence for {}, then all at once, stamped then", _both(restamped), SILENT, unit="s"),
    Fault(
        "gnss-velocity-bias", "velocities are {} off", {"gnss_velocity": _biased_velocity}, (0.1, 0.3, 1.0), unit="m/s"
    ),
    Fault(
        "gnss-covariance-small", "stated variances {} too small", _both(_shrunk), (10.0, 100.0, 1000.0), unit="times"
    ),
    Fault(
        "gnss-covariance-large",
        "stated variances {} too large",
        _both(times("cov_enu")),
        (10.0, 100.0, 1e4),
        unit="times",
    ),
    Fault(
        "gnss-nan",
        "{} has no numbers",
        {"gnss": _without_numbers, "gnss_velocity": spoilt("vel_enu", np.nan)},
        (10.0, 2.0, 1.0),
        words=("one message of ten", "every second message", "every message"),
    ),
    Fault("gnss-dropout", "nothing for {}", _both(lost), None, OUT),
)
