"""Frozen column records: what every log, importer and simulator yields and every filter reads.

Shape, dtype, finiteness and increasing time are checked once, here, naming the column and what arrived.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.frames import Frame as Frame  # noqa: PLC0414 (part of the records, in a file of their own)
from sensors.frames import Sweep as Sweep  # noqa: PLC0414
from sensors.geodesy import MapFrame
from sensors.images import Image as Image  # noqa: PLC0414
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]


class GnssStatus(IntEnum):
    """Quality of a GNSS solution, worst to best."""

    NONE = 0
    SINGLE = 1
    DGNSS = 2
    FLOAT = 3
    FIXED = 4


@dataclass(frozen=True)
class LeftOut:
    """Rows of a source that were not used, and why."""

    source: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Columns over one clock.

    t_ns: (N,) int64, strictly increasing; arrival_ns: (N,) int64.
    """

    t_ns: Nanoseconds
    arrival_ns: Nanoseconds

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: Any) -> Self:
        """The chosen rows (a slice or a mask), as a new record."""
        return type(self)(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def _set(self, name: str, shape: tuple[int, ...], dtype: type = np.float64, *, missing: bool = False) -> None:
        """Check one column against (N, *shape) and store it contiguous; missing: NaN rows are allowed."""
        given = getattr(self, name)
        label = f"{type(self).__name__}.{name}"
        wanted = (len(self.t_ns), *shape)
        array = np.full(wanted, np.nan) if given is None else np.ascontiguousarray(given, dtype=dtype)
        if array.shape != wanted:
            raise EgolocError(f"{label}: expected shape {wanted}, got {array.shape}")
        if dtype is np.float64 and (np.isinf(array).any() if missing else not np.isfinite(array).all()):
            raise EgolocError(f"{label}: expected finite numbers, got NaN or Inf")
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    def _set_time(self) -> None:
        t = np.ascontiguousarray(self.t_ns)
        label = f"{type(self).__name__}.t_ns"
        if t.ndim != 1 or t.dtype != np.int64:
            raise EgolocError(f"{label}: expected (N,) int64 nanoseconds, got {t.shape} {t.dtype}")
        if len(t) > 1 and not (t[1:] > t[:-1]).all():
            row = int(np.argmin(t[1:] > t[:-1])) + 1
            raise EgolocError(f"{label}: expected increasing stamps, row {row} has {t[row]} after {t[row - 1]}")
        object.__setattr__(self, "t_ns", t)
        self._set("arrival_ns", (), np.int64)


def _check_covariance(label: str, cov: Floats, *, missing: bool = False) -> None:
    """Raise unless every matrix is symmetric and positive definite (missing: all-NaN matrices pass)."""
    rows = np.isfinite(cov).all(axis=(1, 2)) if missing else np.ones(len(cov), bool)
    if not rows.any():
        return
    bad = ~positive_definite(cov[rows])
    if bad.any():
        row = int(np.flatnonzero(rows)[np.argmax(bad)])
        raise EgolocError(f"{label}: expected a positive definite covariance, row {row} has {cov[row].tolist()}")


def positive_definite(cov: Floats) -> NDArray[np.bool_]:
    """Which of (N, 3, 3) matrices are finite, symmetric and positive definite, by leading minors: (N,) bool."""
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 0, 2]
    d, e, f = cov[:, 1, 1], cov[:, 1, 2], cov[:, 2, 2]
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(cov.diagonal(axis1=1, axis2=2))
        skew = np.abs(cov - cov.transpose(0, 2, 1))  # of what is not finite NaN, which is no less than anything
        symmetric = (skew <= 1e-6 * sigma[:, :, None] * sigma[:, None, :]).all(axis=(1, 2))
        minor = a * d - b * b
        determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        result: NDArray[np.bool_] = symmetric & (a > 0) & (minor > 0) & (determinant > 0)
    return result


def sound_modes(modes: Floats, weights: Floats) -> NDArray[np.bool_]:
    """Which of (N, 2, 3) modes with weights (N, 2) a PoseFix can hold: (N,) bool."""
    known = np.isfinite(modes).all(axis=2) | (weights == 0.0)
    first, second = weights.T
    result: NDArray[np.bool_] = known.all(axis=1) & (first >= second) & (second >= 0.0) & (first + second <= 1.0 + 1e-9)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Imu(_Columns):
    """Inertial samples in body axes.

    gyro: (N, 3) rad/s, angular rate of the body against inertial space; accel: (N, 3) m/s^2, specific force.
    """

    gyro: Floats
    accel: Floats

    def __post_init__(self) -> None:
        self._set_time()
        self._set("gyro", (3,))
        self._set("accel", (3,))


@dataclass(frozen=True, slots=True, eq=False)
class GnssFix(_Columns):
    """GNSS positions of the antenna.

    llh: (N, 3) rad, rad, m; cov_enu: (N, 3, 3) m^2; status: (N,) int8 GnssStatus;
    yaw, yaw_sigma: (N,) rad, dual-antenna heading of the body (ccw from east), NaN where there is none.
    """

    llh: Floats
    cov_enu: Floats
    status: NDArray[np.int8]
    yaw: Floats = None  # type: ignore[assignment]
    yaw_sigma: Floats = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self._set_time()
        self._set("llh", (3,))
        self._set("cov_enu", (3, 3))
        self._set("status", (), np.int8)
        self._set("yaw", (), missing=True)
        self._set("yaw_sigma", (), missing=True)
        _check_covariance("GnssFix.cov_enu", self.cov_enu)


@dataclass(frozen=True, slots=True, eq=False)
class GnssVelocity(_Columns):
    """GNSS velocities of the antenna. vel_enu: (N, 3) m/s; cov_enu: (N, 3, 3) (m/s)^2."""

    vel_enu: Floats
    cov_enu: Floats

    def __post_init__(self) -> None:
        self._set_time()
        self._set("vel_enu", (3,))
        self._set("cov_enu", (3, 3))
        _check_covariance("GnssVelocity.cov_enu", self.cov_enu)


@dataclass(frozen=True, slots=True, eq=False)
class PoseFix(_Columns):
    """EgoVM's measurements. pose: (N, 3) map x m, map y m, yaw rad; cov: (N, 3, 3) in (m, m, rad), map axes.

    cov is that of the finest level of the histogram; along directions in which a coarser level was flat it has that
    level's as well (``sensors.histogram.stated_covariance``), for there the finest one saw only a corner of the whole.
    modes: (N, 2, 3) the two strongest modes of the posterior, the stronger first, as pose; weights: (N, 2) its mass in
    each. A mode that there is not, or that nobody looked for, has weight 0 and is NaN.
    """

    pose: Floats
    cov: Floats
    modes: Floats = None  # type: ignore[assignment]
    weights: Floats = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self._set_time()
        self._set("pose", (3,))
        self._set("cov", (3, 3))
        _check_covariance("PoseFix.cov", self.cov)
        given: Floats | None = self.weights
        if given is None:
            object.__setattr__(self, "weights", np.zeros((len(self), 2)))
        self._set("modes", (2, 3), missing=True)
        self._set("weights", (2,))
        if self.weights.any() and (bad := ~sound_modes(self.modes, self.weights)).any():
            row = int(np.argmax(bad))
            raise EgolocError(
                "PoseFix.weights: expected falling masses of at most 1 together, and a mode for each above 0, "
                f"row {row} has {self.weights[row].tolist()} for modes {self.modes[row].tolist()}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class WheelSpeed(_Columns):
    """Forward speed of the rear axle. speed, sigma: (N,) m/s."""

    speed: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        self._set_time()
        self._set("speed", ())
        self._set("sigma", ())


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory(_Columns):
    """A reference in map coordinates.

    p_map: (N, 3) m; q_map_body: (N, 4) xyzw, NaN rows where the attitude is unknown;
    sigma: (N, 2) standard deviation of horizontal position m and of yaw rad, NaN where unknown.
    """

    p_map: Floats
    q_map_body: Floats = None  # type: ignore[assignment]
    sigma: Floats = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self._set_time()
        self._set("p_map", (3,))
        self._set("q_map_body", (4,), missing=True)
        self._set("sigma", (2,), missing=True)


@dataclass(frozen=True, slots=True, eq=False)
class Tags(_Columns):
    """What holds from each stamp on until the next: scene tags ("tunnel", or several, "canyon,night") or a drive mode.

    text: (N,) strings; "" says nothing.
    """

    text: NDArray[np.str_]

    def __post_init__(self) -> None:
        self._set_time()
        text = np.ascontiguousarray(self.text, dtype=np.str_)
        if text.shape != self.t_ns.shape:
            raise EgolocError(f"Tags.text: expected shape {self.t_ns.shape}, got {text.shape}")
        text.flags.writeable = False
        object.__setattr__(self, "text", text)


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """One drive: the columns of each sensor that it holds, and what is known of the vehicle and the map."""

    imu: Imu | None = None
    gnss: GnssFix | None = None
    gnss_velocity: GnssVelocity | None = None
    pose_fixes: PoseFix | None = None
    wheel: WheelSpeed | None = None
    reference: Trajectory | None = None
    vehicle: Vehicle = field(default_factory=Vehicle)
    map_frame: MapFrame | None = None
    left_out: Sequence[LeftOut] = ()
    scene: Tags | None = None
    mode: Tags | None = None
