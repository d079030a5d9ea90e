"""Faults of several sensors at once."""

from sensors.simulate.faults.fault import Fault, lost
from sensors.simulate.faults.gnss import jumped, wrongly_fixed
from sensors.simulate.faults.pose_fix import beside

_GNSS_OUT = {"gnss": lost, "gnss_velocity": lost}
_OUT = (5.0, 20.0, 60.0)

FAULTS = (
    Fault(
        "gnss-and-pose-wrong",
        "a fixed solution {} off in some direction, and poses as far to the left",
        {"gnss": wrongly_fixed, "pose_fixes": beside},
        (0.5, 1.5, 4.0),
        unit="m",
    ),
    Fault(
        "gnss-jump-without-pose",
        "positions are {} off while there are no pose fixes",
        {"gnss": jumped, "pose_fixes": lost},
        (1.0, 5.0, 50.0),
        (10.0,) * 3,
        "m",
    ),
    Fault(
        "pose-lane-without-gnss",
        "poses lie {} to the left while there is no GNSS",
        {"pose_fixes": beside, **_GNSS_OUT},
        (1.75, 3.5, 7.0),
        (10.0,) * 3,
        "m",
    ),
    Fault("gnss-and-pose-out", "neither for {}", {**_GNSS_OUT, "pose_fixes": lost}, None, _OUT),
    Fault("all-out", "the IMU alone for {}", {**_GNSS_OUT, "pose_fixes": lost, "wheel": lost}, None, _OUT),
)
