"""`egoloc allan`: noise figures of an IMU from the longest stretch of a log at rest, in the units of [vehicle.imu]."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isinf, radians, sqrt
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from replay.config import RunConfig, to_toml
from replay.sources import LogSource
from sensors.allan import DRIFT_SPAN_S, AllanCurve, SensorNoise, allan_curve, noise_of, pooled
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.pieces import joined
from sensors.records import GnssVelocity, Imu, WheelSpeed
from sensors.standstill import Rest, longest_rest
from sensors.vehicle import ImuSpec, Vehicle

AXES = ("x", "y", "z", "all")
"""Of the body; all: the mean of their variances."""
SPAN_SHORT_S = 3600.0
"""Below this a drift of the usual time constants is hardly turning back, s."""
ROOT_HOUR = 60.0


@dataclass(frozen=True)
class Units:
    """What a datasheet calls the figures of a sensor: suffixes of names, and what one SI unit is in them."""

    walk: str
    walk_scale: float
    drift: str
    drift_scale: float


UNITS = {
    "gyro": Units("deg_per_sqrt_h", ROOT_HOUR / radians(1.0), "deg_per_h", 3600.0 / radians(1.0)),
    "accel": Units("m_per_s_per_sqrt_h", ROOT_HOUR, "mg", 1e3 / 9.80665),
}


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """facts: what `--json` prints; curves: of gyro and accelerometer; noise: of each of AXES; vehicle: with the IMU
    that was found."""

    facts: dict[str, Any]
    curves: dict[str, AllanCurve]
    noise: dict[str, dict[str, SensorNoise]]
    vehicle: Vehicle


def analyse(source: LogSource, config: RunConfig, from_s: float | None = None, to_s: float | None = None) -> Analysis:
    """The noise of a log's IMU at rest, between two times after its first sample (None: its ends).

    Raises EgolocError, naming the log, where there is no IMU, no rest, or too little to say anything.
    """
    try:
        imu, speeds, vehicle = _read(source, config, from_s, to_s)
        rest = longest_rest(imu[0], speeds)
        signals = {"gyro": rest.gyro, "accel": rest.accel}
        curves = {name: allan_curve(signal, rest.interval_s) for name, signal in signals.items()}
        noise = {name: _noise_of_axes(curve) for name, curve in curves.items()}
    except EgolocError as error:
        raise EgolocError(f"{source.where}: {error}") from None
    spec, unsaid = imu_spec(config.vehicle.imu if config.vehicle else vehicle.imu, noise, source.name)
    warnings = [*_warnings(rest, bool(speeds), noise), *unsaid]
    found = msgspec.structs.replace(config.vehicle or vehicle, imu=spec)
    facts = {
        "log": source.where,
        "rate_hz": round(1.0 / rest.interval_s, 4),
        "duration_s": (int(imu[0].t_ns[-1]) - int(imu[0].t_ns[0])) / NS_PER_S,
        "rest": _rest_facts(rest, imu[1]),
        **{name: {axis: figures(name, n) for axis, n in axes.items()} for name, axes in noise.items()},
        "vehicle_imu": msgspec.to_builtins(spec),
        "warnings": warnings,
        "curve": {name: _curve_facts(name, curve) for name, curve in curves.items()},
    }
    return Analysis(facts, curves, noise, found)


def figures(sensor: str, noise: SensorNoise) -> dict[str, float | bool | None]:
    """Figures of one axis in the units of a datasheet; None: the record does not show it."""
    units = UNITS[sensor]
    walk, drift = units.walk_scale, units.drift_scale
    shows, turns = noise.drift_rate > 0, not isinf(noise.drift_sigma)
    return {
        f"random_walk_{units.walk}": noise.random_walk * walk,
        "random_walk_error": noise.random_walk_error * walk,
        f"bias_instability_{units.drift}": noise.instability * drift,
        "bias_instability_error": noise.instability_error * drift,
        "bias_instability_at_s": noise.instability_tau_s,
        "bias_instability_reached": noise.instability_reached,
        f"rate_random_walk_{units.drift}_per_sqrt_h": noise.drift_rate * drift * ROOT_HOUR if shows else None,
        "rate_random_walk_error": noise.drift_rate_error * drift * ROOT_HOUR if shows else None,
        f"drift_sigma_{units.drift}": noise.drift_sigma * drift if turns else None,
        "drift_time_s": noise.drift_time_s if turns else None,
    }


def imu_spec(given: ImuSpec, noise: dict[str, dict[str, SensorNoise]], name: str) -> tuple[ImuSpec, list[str]]:
    """The given datasheet with what was found in place of its figures, and what had to be left as it was.

    The filter's drifts share one time constant and it uses 2 sigma^2 / T of each alone: T is the gyro's where that
    shows, else the accelerometer's, else the given one, and each sigma is the one that makes the product right.
    """
    gyro, accel = noise["gyro"]["all"], noise["accel"]["all"]
    known = [n.drift_time_s for n in (gyro, accel) if n.drift_rate > 0 and not isinf(n.drift_time_s)]
    time_s = known[0] if known else given.bias_time_constant_s
    changes: dict[str, Any] = {
        "name": f"allan-{name}",
        "gyro_noise_deg_per_sqrt_h": gyro.random_walk * UNITS["gyro"].walk_scale,
        "accel_noise_m_per_s_per_sqrt_h": accel.random_walk * UNITS["accel"].walk_scale,
    }
    unsaid = []
    fields = {"gyro": "gyro_bias_instability_deg_per_h", "accel": "accel_bias_instability_mg"}
    if gyro.drift_rate > 0 or accel.drift_rate > 0:
        changes["bias_time_constant_s"] = time_s
    for sensor, field in fields.items():
        found = noise[sensor]["all"]
        if found.drift_rate > 0:
            changes[field] = found.drift_rate * sqrt(time_s / 2.0) * UNITS[sensor].drift_scale
        elif "bias_time_constant_s" in changes:  # the same drift by another time constant
            changes[field] = getattr(given, field) * sqrt(time_s / given.bias_time_constant_s)
        if found.drift_rate == 0:
            unsaid.append(f"no drift of the {sensor} shows: {field} is the given one, not measured")
    rounded = {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in changes.items()}
    return msgspec.structs.replace(given, **rounded), unsaid


def vehicle_toml(analysis: Analysis) -> str:
    """The lines to paste into a config: its [vehicle] replaces the log's, so it is whole."""
    return to_toml(_Pasted(analysis.vehicle))


class _Pasted(msgspec.Struct, frozen=True):
    """What of a config is printed."""

    vehicle: Vehicle


def _read(
    source: LogSource, config: RunConfig, from_s: float | None, to_s: float | None
) -> tuple[tuple[Imu, int], list[GnssVelocity | WheelSpeed], Vehicle]:
    """The IMU between two times with the stamp of the log's first sample; speeds; the log's vehicle."""
    kept: dict[str, list[Any]] = {"imu": [], "gnss_velocity": [], "wheel": []}
    vehicle = Vehicle()
    for piece in source.pieces(config):
        vehicle = piece.vehicle
        for name, records in kept.items():
            record = getattr(piece, name)
            if record is not None and len(record):
                records.append(record)
    if not kept["imu"]:
        raise EgolocError("the log has no IMU samples: expected sensor_msgs/msg/Imu on a topic")
    imu: Imu = joined(kept.pop("imu"))
    first_ns = int(imu.t_ns[0])
    t = (imu.t_ns - first_ns) / NS_PER_S
    chosen = (t >= (0.0 if from_s is None else from_s)) & (t <= (t[-1] if to_s is None else to_s))
    if chosen.sum() < 2:
        raise EgolocError(f"--from, --to: expected times within the log's {t[-1]:.1f} s, got {from_s}, {to_s}")
    return (imu[chosen], first_ns), [joined(records) for records in kept.values() if records], vehicle


def _noise_of_axes(curve: AllanCurve) -> dict[str, SensorNoise]:
    found = {axis: noise_of(curve, column) for column, axis in enumerate(AXES[:3])}
    return found | {"all": noise_of(pooled(curve))}


def _rest_facts(rest: Rest, first_ns: int) -> dict[str, Any]:
    begin, end = ((t - first_ns) / NS_PER_S for t in rest.t_ns)
    return {
        "from_s": begin,
        "to_s": end,
        "length_s": end - begin,
        "whole": rest.whole,
        "filled_samples": rest.filled,
        "quiet_s": rest.seconds,
    }


def _curve_facts(sensor: str, curve: AllanCurve) -> dict[str, list[float]]:
    """Deviations in the units of the drift."""
    deviation = np.sqrt(curve.variance) * UNITS[sensor].drift_scale
    axes = {axis: deviation[:, column].tolist() for column, axis in enumerate(AXES[:3])}
    return {"tau_s": curve.tau.tolist(), "clusters": curve.clusters.tolist(), **axes}


def _warnings(rest: Rest, has_speed: bool, noise: dict[str, dict[str, SensorNoise]]) -> Iterable[str]:
    """What a reader of the figures must know."""
    length = (rest.t_ns[1] - rest.t_ns[0]) / NS_PER_S
    if not rest.whole:
        yield "the vehicle moves, or is not quiet, in the rest of the log: only its longest stretch at rest counts"
    if not has_speed:
        yield "no GNSS velocity and no wheel speed: that nothing moves is judged by the IMU alone"
    if rest.filled:
        yield f"{rest.filled} lost samples lie on a line between their neighbours"
    if length < DRIFT_SPAN_S:
        yield f"{length:.0f} s are too short for drifts: {DRIFT_SPAN_S:g} s at least, hours are better"
    elif length < SPAN_SHORT_S:
        yield f"{length:.0f} s are short for drifts: bias figures are rough, hours are better"
    shaken = [f"{sensor} {axis}" for sensor, axes in noise.items() for axis in AXES[:3] if _shaken(axes[axis])]
    if shaken:
        yield f"random walk stands apart from what shakes the IMU by its slope alone: {', '.join(shaken)}"


def _shaken(noise: SensorNoise) -> bool:
    """Whether the fit of the random walk rests on little: nothing found, or known to a tenth only."""
    return noise.random_walk_error > 0.1 * noise.random_walk or not noise.random_walk


FILES = ("allan.png", "allan.json", "vehicle.toml")
"""What is written into the folder."""


def check_folder(out: Path) -> None:
    """Raise unless a folder is new, empty or one of an earlier analysis."""
    if not out.exists():
        return
    others: Sequence[str] = sorted(p.name for p in out.iterdir() if p.name not in FILES) if out.is_dir() else [out.name]
    if others:
        raise EgolocError(f"{out}: expected a new folder or one of an earlier analysis, got one with {others[0]}")
