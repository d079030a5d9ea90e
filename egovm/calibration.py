"""Covariances of a network's histograms, brought to the size of its errors: R = D Sigma D + diag(b step^2 / 12).

Level by level: Sigma is the histogram's covariance. D is diagonal, D_ii^2 = a_i v_i^(power_i - 1) with the variance
v_i = Sigma_ii / step_i^2: each axis' variance becomes a v^power, and correlations stay. b counts what a candidate's own
cell adds (step^2 / 12 is the variance of a uniform error one step wide). The mean is not touched, as a temperature on
the scores would.

Why a power: trained to spread its target over the candidates around the truth, a network that is sure is off by far
less than its histogram is wide, one that is not sure by about as much. A factor alone (power 1) is too large for the
one or too small for the other.

``calibration_fit`` finds a, b and power on worlds of their own; they lie beside the weights, in NAME-calibration.toml,
and hold for those alone.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from egovm.config import LatticeConfig
from egovm.config_file import config_toml, read_toml
from sensors.errors import EgolocError
from sensors.histogram import stated_covariance
from sensors.whole_file import whole_file

Floats = NDArray[np.float64]

WIDE_SHARE = 3.0 / 16.0
"""Of a flat window's variance: sigma is then half of what the next level searches on either side, so that the truth may
well lie beyond it."""
_HEAD = """\
# Covariances of the weights beside it: R = D Sigma D + diag(b step^2 / 12), D = diag(sqrt(a v^(power - 1))) with the
# variances v of Sigma in step^2. Rows: levels, coarse to fine; columns: longitudinal, lateral, yaw.
# Written by egoloc eval --calibrate. nll: mean negative log likelihood of the used frames' errors, nats.

"""
_A = Annotated[float, msgspec.Meta(gt=0.0, lt=1e12)]
_B = Annotated[float, msgspec.Meta(ge=0.0, lt=1e12)]
_Power = Annotated[float, msgspec.Meta(ge=1.0, le=4.0)]


class Fit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a calibration was found."""

    frames: int
    """Of the calibration's worlds."""
    noise: tuple[str, ...]
    """Presets of the initial poses, which take turns."""
    maps: tuple[str, ...]
    """What there was of the maps, in turns as well."""
    seed: int
    """Of that noise."""
    used: tuple[int, ...]
    """Frames by level: those with landmarks whose truth lay in the level's window."""
    nll_before: tuple[float, ...]
    """Mean negative log likelihood of their errors by level, nats, in steps of the level."""
    nll_after: tuple[float, ...]


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights_sha256: str
    a: tuple[tuple[_A, _A, _A], ...]
    b: tuple[tuple[_B, _B, _B], ...]
    power: tuple[tuple[_Power, _Power, _Power], ...]
    fit: Fit


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """a: (L, 3) factors of the variances; b: (L, 3) of step^2 / 12; power: (L, 3) of the variances; fit: None where
    the network has no calibration: covariances then stay as they are."""

    a: Floats
    b: Floats
    power: Floats
    lattice: LatticeConfig
    fit: Fit | None = None

    def calibrated(self, cov: ArrayLike, level: int) -> Floats:
        """Covariances (..., 3, 3) of a level in (m, m, rad), body axes at its centre. Infinite ones stay infinite."""
        return self._widened(np.asarray(cov, np.float64), level)

    def of_levels(self, cov: ArrayLike) -> Floats:
        """The same of all levels (..., L, 3, 3)."""
        return self._widened(np.asarray(cov, np.float64), slice(None))

    def _widened(self, cov: Floats, rows: int | slice) -> Floats:
        step = steps_of(self.lattice)[rows]
        variance = np.diagonal(cov, axis1=-2, axis2=-1) / step**2
        finite = np.where(np.isfinite(variance), variance, 1.0)
        scale = np.sqrt(self.a[rows] * finite ** (self.power[rows] - 1.0))
        scaled: Floats = cov * scale[..., :, None] * scale[..., None, :]
        return scaled + (self.b[rows] * step**2 / 12.0)[..., None] * np.eye(3)


def stated(calibration: Calibration, cov: ArrayLike, yaw: ArrayLike) -> Floats:
    """(N, 3, 3) what a fix states, in body axes at the last level's centre: the last level's covariance calibrated, and
    along directions in which a level was too wide for the next one that level's as it is (``sensors.histogram``).

    cov: (N, L, 3, 3) of the histograms; yaw: (N, L) of the levels' centres, rad. Infinite where the last level's is.
    """
    raw, yaws = np.asarray(cov, np.float64), np.asarray(yaw, np.float64)
    known = np.isfinite(np.abs(raw).max(axis=(1, 2, 3)))
    angle = (yaws - yaws[:, -1:])[known]
    R = np.zeros((*angle.shape, 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(angle)
    R[..., 1, 0] = np.sin(angle)
    R[..., 0, 1] = -R[..., 1, 0]
    R[..., 2, 2] = 1.0
    turned = R @ raw[known] @ R.swapaxes(-1, -2)
    lattice = calibration.lattice
    flat = steps_of(lattice) * np.sqrt((lattice.steps**2 - 1) / 12.0)
    found = calibration.calibrated(raw[:, -1], -1)
    found[known] += stated_covariance(turned, flat, WIDE_SHARE) - turned[:, -1]
    return found


def uncalibrated(lattice: LatticeConfig) -> Calibration:
    """Leaves covariances as they are."""
    ones = np.ones((lattice.levels, 3))
    return Calibration(ones, np.zeros_like(ones), ones, lattice)


def steps_of(lattice: LatticeConfig) -> Floats:
    """(L, 3) distance of neighbours by level, m, m, rad."""
    levels = range(lattice.levels)
    return np.array([(lattice.step_m(level), lattice.step_m(level), lattice.step_rad(level)) for level in levels])


def calibration_path(weights: Path) -> Path:
    """Where the calibration of weights lies."""
    return weights.with_name(f"{weights.stem}-calibration.toml")


def read_calibration(weights: Path, lattice: LatticeConfig) -> Calibration:
    """That of weights; where they have none, one that leaves covariances as they are (its ``fit`` is None).

    Raises EgolocError for a file that is none, of other levels or of other weights.
    """
    path = calibration_path(weights)
    if not path.is_file():
        return uncalibrated(lattice)
    given = read_toml(path, _File, "a calibration")
    for name, rows in (("a", given.a), ("b", given.b), ("power", given.power)):
        if len(rows) != lattice.levels:
            raise EgolocError(f"{path}: {name}: expected {lattice.levels} rows, the network's levels, got {len(rows)}")
    if given.weights_sha256 != _sha256(weights):
        raise EgolocError(
            f"{path}: weights_sha256: expected that of {weights.name}, got another's: egoloc eval --calibrate fits anew"
        )
    a, b, power = (np.array(rows) for rows in (given.a, given.b, given.power))
    return Calibration(a, b, power, lattice, given.fit)


def write_calibration(calibration: Calibration, weights: Path) -> Path:
    """Write it beside its weights; returns where. Raises EgolocError where that cannot be, or it was never fitted."""
    if calibration.fit is None:
        raise EgolocError(f"{weights}: expected a calibration that was fitted")
    path = calibration_path(weights)
    held = _File(
        weights_sha256=_sha256(weights),
        a=_rows(calibration.a),
        b=_rows(calibration.b),
        power=_rows(calibration.power),
        fit=calibration.fit,
    )
    with whole_file(path) as part:
        part.write_text(_HEAD + config_toml(held))
    return path


def _rows(values: Floats) -> tuple[tuple[float, float, float], ...]:
    return tuple((lon, lat, yaw) for lon, lat, yaw in values.tolist())


def _sha256(weights: Path) -> str:
    try:
        return hashlib.sha256(weights.read_bytes()).hexdigest()
    except OSError as error:
        raise EgolocError(f"{weights}: expected weights of a network: {error.strerror}") from None
