"""Covariances of a network's histograms, brought to the size of its errors: R = D Sigma D + diag(b step^2 / 12).

Level by level: Sigma is the histogram's covariance, D = diag(sqrt(a)) widens or narrows it along each axis and leaves
correlations as they are, b counts what a candidate's own cell adds (step^2 / 12 is the variance of a uniform error one
step wide). The mean is not touched, as a temperature on the scores would. ``calibration_fit`` finds a and b on worlds
of their own; they lie beside the weights, in NAME-calibration.toml, and hold for those alone.
"""

import hashlib
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from egovm.config import LatticeConfig
from egovm.config_file import config_toml, read_toml
from sensors.errors import EgolocError
from sensors.whole_file import whole_file

Floats = NDArray[np.float64]

_HEAD = """\
# Of the covariances beside it: R = D Sigma D + diag(b step^2 / 12), D = diag(sqrt(a)), rows by level, columns lon, lat,
# yaw. Written by egoloc eval --calibrate; nll: mean, in nats, of used frames, before and after.

"""
_A = Annotated[float, msgspec.Meta(gt=0.0, lt=1e12)]
_B = Annotated[float, msgspec.Meta(ge=0.0, lt=1e12)]


class Fit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a calibration was found."""

    frames: int
    """Of the calibration's worlds."""
    noise: tuple[str, ...]
    """Presets of the initial poses, which take turns."""
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
    fit: Fit


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """a: (L, 3) factors of the variances; b: (L, 3) of step^2 / 12; step: (L, 3) of the lattice, m, m, rad; fit: None
    where the network has no calibration: covariances then stay as they are."""

    a: Floats
    b: Floats
    step: Floats
    fit: Fit | None = None

    def calibrated(self, cov: ArrayLike, level: int) -> Floats:
        """Covariances (..., 3, 3) of a level in (m, m, rad), body axes at its centre. Infinite ones stay infinite."""
        return _widened(cov, self.a[level], self.b[level], self.step[level])

    def of_levels(self, cov: ArrayLike) -> Floats:
        """The same of all levels (..., L, 3, 3)."""
        return _widened(cov, self.a, self.b, self.step)


def uncalibrated(lattice: LatticeConfig) -> Calibration:
    """Leaves covariances as they are."""
    step = steps_of(lattice)
    return Calibration(np.ones_like(step), np.zeros_like(step), step)


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
    for name, rows in (("a", given.a), ("b", given.b)):
        if len(rows) != lattice.levels:
            raise EgolocError(f"{path}: {name}: expected {lattice.levels} rows, the network's levels, got {len(rows)}")
    if given.weights_sha256 != _sha256(weights):
        raise EgolocError(
            f"{path}: weights_sha256: expected those of {weights.name}, got other ones: egoloc eval --calibrate fits anew"
        )
    return Calibration(np.array(given.a), np.array(given.b), steps_of(lattice), given.fit)


def write_calibration(calibration: Calibration, weights: Path) -> Path:
    """Write it beside its weights; returns where. Raises EgolocError where that cannot be, or it was never fitted."""
    if calibration.fit is None:
        raise EgolocError(f"{weights}: expected a calibration that was fitted")
    path = calibration_path(weights)
    rows = [tuple(map(tuple, values.tolist())) for values in (calibration.a, calibration.b)]
    text = _HEAD + config_toml(_File(_sha256(weights), *rows, calibration.fit))
    with whole_file(path) as part:
        part.write_text(text)
    return path


def _widened(cov: ArrayLike, a: Floats, b: Floats, step: Floats) -> Floats:
    """(..., 3, 3); a, b, step: (..., 3)."""
    scale = np.sqrt(a)
    scaled: Floats = np.asarray(cov, np.float64) * scale[..., :, None] * scale[..., None, :]
    return scaled + (b * step**2 / 12.0)[..., None] * np.eye(3)


def _sha256(weights: Path) -> str:
    try:
        return hashlib.sha256(weights.read_bytes()).hexdigest()
    except OSError as error:
        raise EgolocError(f"{weights}: expected weights of a network: {error.strerror}") from None
