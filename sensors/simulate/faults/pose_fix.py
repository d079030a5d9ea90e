"""Faults of map matching: aliases, poses turned or frozen, covariances that are no covariances."""

import numpy as np

from sensors.rotation import wrap
from sensors.simulate.faults.fault import (
    During,
    Fault,
    Floats,
    Rows,
    ahead,
    every,
    late,
    lost,
    overtaken,
    repeated,
    spoilt,
    stuck,
    times,
)
from sensors.simulate.faults.gnss import OUT, SHORT


def moved(rows: Rows, along: Floats | float, left: Floats | float, turn: Floats | float = 0.0) -> Rows:
    """Poses moved along and left of their own heading, m, and turned, rad."""
    pose = rows.columns["pose"].copy()
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    pose[:, 0] += c * along - s * left
    pose[:, 1] += s * along + c * left
    pose[:, 2] = wrap(pose[:, 2] + turn)
    return rows.having(pose=pose)


def beside(rows: Rows, during: During) -> Rows:
    """Poses lie to the left by the size, m."""
    return moved(rows, 0.0, during.size)


def _beyond(rows: Rows, during: During) -> Rows:
    return moved(rows, during.size, 0.0)


def _sliding(rows: Rows, during: During) -> Rows:
    return moved(rows, 0.0, during.size * during.since_s)


def _turned(rows: Rows, during: During) -> Rows:
    return moved(rows, 0.0, 0.0, np.radians(during.size))


def _outlying(rows: Rows, during: During) -> Rows:
    """One pose of five is off, anywhere: by the size, m, and by as many degrees."""
    angle = during.rng.uniform(-np.pi, np.pi, len(rows.true_ns))
    size = np.where(during.number % 5 == 0, during.size, 0.0)
    return moved(rows, size * np.cos(angle), size * np.sin(angle), np.radians(size) * np.sign(angle))


def _noisy(rows: Rows, during: During) -> Rows:
    noise = during.size * during.rng.standard_normal((len(rows.true_ns), 3))
    return moved(rows, noise[:, 0], noise[:, 1], np.radians(noise[:, 2]))


def _shrunk(rows: Rows, during: During) -> Rows:
    return rows.having(cov=rows.columns["cov"] / during.size)


def _indefinite(rows: Rows, during: During) -> Rows:
    """x and y are more correlated than two numbers can be."""
    cov, bad = rows.columns["cov"].copy(), every(during)
    cov[bad, 0, 1] = cov[bad, 1, 0] = 2.0 * np.sqrt(cov[bad, 0, 0] * cov[bad, 1, 1])
    return rows.having(cov=cov)


_SHARES = ("one fix of ten", "every second fix", "every fix")

FAULTS = (
    Fault("pose-lane", "poses lie {} to the left", {"pose_fixes": beside}, (1.75, 3.5, 7.0), (10.0,) * 3, "m"),
    Fault("pose-dash", "poses lie {} ahead", {"pose_fixes": _beyond}, (3.0, 6.0, 12.0), (10.0,) * 3, "m"),
    Fault(
        "pose-drift", "poses slide to the left by {}", {"pose_fixes": _sliding}, (0.03, 0.1, 0.3), (40.0,) * 3, "m/s"
    ),
    Fault("pose-rotated", "poses are turned by {}", {"pose_fixes": _turned}, (1.0, 2.0, 10.0), unit="deg"),
    Fault("pose-outliers", "one fix of five is {} off", {"pose_fixes": _outlying}, (1.0, 3.0, 10.0), unit="m and deg"),
    Fault(
        "pose-noise",
        "white noise of {} that the covariance does not tell",
        {"pose_fixes": _noisy},
        (0.1, 0.3, 1.0),
        unit="m and deg",
    ),
    Fault("pose-stuck", "the pose stays the same for {}", {"pose_fixes": stuck("pose")}, None, SHORT),
    Fault("pose-time-jump", "stamps run {} ahead", {"pose_fixes": ahead}, (0.1, 0.5, 2.0), unit="s"),
    Fault(
        "pose-swapped",
        "every second message is {} late and overtaken; stamps are right",
        {"pose_fixes": overtaken},
        (0.15, 0.4, 0.9),
        unit="s",
    ),
    Fault(
        "pose-repeated",
        "every message comes again {}, 1 ms apart by their stamps",
        {"pose_fixes": repeated},
        (1.0, 4.0, 9.0),
        unit="times",
    ),
    Fault("pose-latency", "messages are {} late; stamps are right", {"pose_fixes": late}, (0.1, 0.5, 2.0), unit="s"),
    Fault(
        "pose-covariance-small",
        "stated variances {} too small",
        {"pose_fixes": _shrunk},
        (10.0, 100.0, 1000.0),
        unit="times",
    ),
    Fault(
        "pose-covariance-large",
        "stated variances {} too large",
        {"pose_fixes": times("cov")},
        (10.0, 100.0, 1e4),
        unit="times",
    ),
    Fault(
        "pose-covariance-nan",
        "{} has a covariance without numbers",
        {"pose_fixes": spoilt("cov", np.nan)},
        (10.0, 2.0, 1.0),
        words=_SHARES,
    ),
    Fault(
        "pose-covariance-indefinite",
        "{} has a covariance that is not positive definite",
        {"pose_fixes": _indefinite},
        (10.0, 2.0, 1.0),
        words=_SHARES,
    ),
    Fault("pose-dropout", "nothing for {}", {"pose_fixes": lost}, None, OUT),
)
