"""Faults of sensors, for any drive: what there is (FAULTS), how they are asked for (spec), how they act (inject)."""

from collections.abc import Mapping

from sensors.simulate.faults import gnss, imu, pose_fix, several, wheel
from sensors.simulate.faults.fault import SEVERITIES, Fault

__all__ = ["FAULTS", "SEVERITIES", "Fault"]

FAULTS: Mapping[str, Fault] = {
    fault.name: fault for part in (gnss, imu, pose_fix, wheel, several) for fault in part.FAULTS
}
"""By name."""
