"""What a drive showed of the calibration, for metrics.json and for people."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from fusion.result import Estimated

NAMES = {
    "wheel_scale": "wheel scale",
    "pose_yaw": "yaw of pose fixes",
    "gyro_scale": "gyro scale",
    "gyro_misalignment_x": "gyro misalignment x",
    "gyro_misalignment_y": "gyro misalignment y",
    "gnss_arm_x": "lever arm x",
    "gnss_arm_y": "lever arm y",
    "gnss_arm_z": "lever arm z",
    "mounting_pitch": "mounting pitch",
    "mounting_yaw": "mounting yaw",
    "gnss_delay": "GNSS delay",
    "pose_delay": "pose fix delay",
}


def estimate_facts(found: Sequence[Estimated]) -> list[dict[str, Any]]:
    """As JSON holds it: what is not finite (the filter diverged) is null."""
    return [{key: _finite(value) for key, value in asdict(each).items()} for each in found]


def calibration_notes(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A line of what the drive shows, and one of what it does not."""
    shown, silent = ([each for each in found if each["excited"] is excited] for excited in (True, False))
    if shown:
        yield f"Estimated: {', '.join(_value(each) for each in shown)}."
    if silent:
        yield f"Not excited by this drive, so the prior stays: {', '.join(_value(each) for each in silent)}."


def _value(each: Mapping[str, Any]) -> str:
    """Name, value and sigma with two digits of the sigma."""
    name = NAMES.get(each["name"], each["name"])
    if each["value"] is None or each["sigma"] is None:
        return f"{name} unknown"
    digits = max(0, 1 - math.floor(math.log10(each["sigma"]))) if each["sigma"] > 0 else 3
    return f"{name} {each['value']:.{digits}f} +- {each['sigma']:.{digits}f} {each['unit']}"


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
