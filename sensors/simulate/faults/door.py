"""The door of a record: rows that it cannot hold are left out and counted, as those of a log's messages are."""

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.mcap.decoded import LATE_NS
from sensors.sanity import MAX_COORDINATE, MAX_FORCE, MAX_RATE, MAX_SPEED, covariance_valid, finite_rows, sane
from sensors.simulate.faults.fault import Mask, Rows

Columns = Mapping[str, NDArray[Any]]

_LONG_AGO_NS = -(2**62)


def _imu(columns: Columns) -> dict[str, Mask]:
    return {
        **sane("angular_velocity", columns["gyro"], MAX_RATE, "rad/s"),
        **sane("linear_acceleration", columns["accel"], MAX_FORCE, "m/s^2"),
    }


def _gnss(columns: Columns) -> dict[str, Mask]:
    return {
        "latitude, longitude or altitude is not finite": finite_rows(columns["llh"]),
        **covariance_valid("position_covariance", columns["cov_enu"]),
    }


def _gnss_velocity(columns: Columns) -> dict[str, Mask]:
    return sane("twist.linear", columns["vel_enu"], MAX_SPEED, "m/s") | covariance_valid(
        "twist.covariance", columns["cov_enu"]
    )


def _pose_fixes(columns: Columns) -> dict[str, Mask]:
    return sane("pose.position", columns["pose"][:, :2], MAX_COORDINATE, "m") | covariance_valid(
        "pose.covariance of x, y, yaw", columns["cov"]
    )


def _wheel(columns: Columns) -> dict[str, Mask]:
    return sane("twist.linear.x", columns["speed"][:, None], MAX_SPEED, "m/s")


_VALID: Mapping[str, Callable[[Columns], dict[str, Mask]]] = {
    "imu": _imu,
    "gnss": _gnss,
    "gnss_velocity": _gnss_velocity,
    "pose_fixes": _pose_fixes,
    "wheel": _wheel,
}


class Door:
    """Lets the rows of one record in as they come, and gives them out as records, by stamp."""

    def __init__(self, name: str) -> None:
        self.left_out: Counter[str] = Counter()
        """How many rows were left out for each reason; only grows."""
        self._valid = _VALID[name]
        self._late_ns = 0 if name == "imu" else LATE_NS
        self._newest_ns = _LONG_AGO_NS
        self._columns: Columns | None = None

    def admit(self, rows: Rows) -> None:
        """Take the next rows, in the order in which they come."""
        keep = np.ones(len(rows.true_ns), bool)
        for reason, passes in self._valid(rows.columns).items():
            keep = self._without(keep, ~passes, reason)
        t_ns = rows.columns["t_ns"]
        newest = np.maximum.accumulate(np.concatenate(([self._newest_ns], np.where(keep, t_ns, self._newest_ns))))
        keep = self._without(keep, t_ns < newest[:-1] - self._late_ns, "stamp goes back")
        self._newest_ns = int(newest[-1])
        mine = {name: column[keep] for name, column in rows.columns.items()}
        held = self._columns
        self._columns = self._sorted(mine if held is None else _stacked(held, mine))

    def take(self, until_ns: int | None, kind: type[Any]) -> Any:
        """Those with stamps up to a time (None: all) as a record of a kind; None where there are none."""
        if self._columns is None:
            return None
        t_ns = self._columns["t_ns"]
        count = len(t_ns) if until_ns is None else int(np.searchsorted(t_ns, until_ns, side="right"))
        due = {name: column[:count] for name, column in self._columns.items()}
        self._columns = {name: column[count:] for name, column in self._columns.items()}
        return kind(**due) if count else None

    def _sorted(self, columns: Columns) -> Columns:
        """In the order of their stamps, of equal ones the first."""
        t_ns = columns["t_ns"]
        if (t_ns[1:] > t_ns[:-1]).all():
            return columns
        order = np.argsort(t_ns, kind="stable")
        again = np.diff(t_ns[order], prepend=t_ns[order[0]] - 1) == 0
        self.left_out["stamp repeats"] += int(again.sum())
        return {name: column[order[~again]] for name, column in columns.items()}

    def _without(self, keep: Mask, bad: Mask, reason: str) -> Mask:
        self.left_out[reason] += int((keep & bad).sum())
        return keep & ~bad


def _stacked(first: Columns, second: Columns) -> Columns:
    return {name: np.concatenate((column, second[name])) for name, column in first.items()}
