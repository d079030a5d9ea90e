"""What a drive has shown of the calibration: each constant that is estimated along, and whether the drive excited it.

A state is excited when its sigma fell below half of its prior: then the drive told at least three times as much of it
as was known before (1/sigma^2 = 1/prior^2 + what the drive tells), and another prior would hardly change the result.
Any other keeps its prior, nearly: what the filter makes of it is no finding.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from fusion.config import FusionConfig
from fusion.layout import OFF, layout_of, prior_variances
from fusion.result import Estimated, Sensor
from fusion.state import E_WHEEL_SCALE, T_SEEN, Core
from sensors.vehicle import Vehicle

EXCITED = 0.5
"""Largest sigma over its prior of a state that the drive excited."""
_DEGREE = math.degrees(1.0)


@dataclass(frozen=True, slots=True)
class _Block:
    """parts: of its states' names; factor: from the state's unit to the printed one; sensor: without which nobody asked
    for it (None: it is there only where it was asked for)."""

    name: str
    parts: tuple[str, ...]
    unit: str
    factor: float
    sensor: Sensor | None = None


_BLOCKS = (
    _Block("wheel_scale", ("",), "%", 100.0, Sensor.WHEEL),
    _Block("pose_yaw", ("",), "deg", _DEGREE, Sensor.POSE_FIX),
    _Block("gyro_scale", ("",), "ppm", 1e6),
    _Block("gyro_misalignment", ("_x", "_y"), "deg", _DEGREE),
    _Block("gnss_arm", ("_x", "_y", "_z"), "m", 1.0),
    _Block("mounting", ("_pitch", "_yaw"), "deg", _DEGREE),
    _Block("gnss_delay", ("",), "s", 1.0),
    _Block("pose_delay", ("",), "s", 1.0),
)
"""Constants. Errors of measurements that last (``fusion.blocks``) are none."""


def estimates(core: Core | None, vehicle: Vehicle, config: FusionConfig) -> tuple[Estimated, ...]:
    """Every constant of a filter. core: as it is now; None: before the first state, when all have their priors.

    What is always estimated (the wheel's scale, the yaw of pose fixes) is left out until its sensor is heard of.
    """
    return tuple(_found(core, vehicle, config))


def _found(core: Core | None, vehicle: Vehicle, config: FusionConfig) -> Iterator[Estimated]:
    layout, priors = layout_of(vehicle, config), prior_variances(vehicle, config)
    priors[E_WHEEL_SCALE] = config.motion.wheel_scale_sigma**2 if config.motion.wheel else 0.0
    for block in _BLOCKS:
        first = E_WHEEL_SCALE if block.name == "wheel_scale" else getattr(layout, block.name)
        if first == OFF or priors[first] == 0.0:
            continue
        if block.sensor is not None and (core is None or core.trust[block.sensor, T_SEEN] < 0):
            continue
        for i, part in enumerate(block.parts):
            k, factor = first + i, block.factor
            change, variance = (0.0, priors[k]) if core is None else (core.nav[k + 1], core.P[k, k])
            given, sigma, prior = _given(block.name, i, vehicle), math.sqrt(max(variance, 0.0)), math.sqrt(priors[k])
            value = given + factor * float(change)
            excited = bool(sigma < EXCITED * prior)
            yield Estimated(f"{block.name}{part}", block.unit, given, value, factor * sigma, factor * prior, excited)


def _given(block: str, i: int, vehicle: Vehicle) -> float:
    """What the vehicle says of a state; the delay is that of GNSS positions (velocities share the change)."""
    if block == "gnss_arm":
        return float(vehicle.gnss_lever_arm[i])
    return float(vehicle.gnss_delay_s) if block == "gnss_delay" else 0.0
