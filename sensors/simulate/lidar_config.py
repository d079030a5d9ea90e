"""Every number of the simulated LiDAR."""

from typing import Annotated

import msgspec

from sensors.bounds import Fraction, Lever, NonNegative, check_order

Vector3 = tuple[Lever, Lever, Lever]


class LidarSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spinning LiDAR with the rings of a Hesai Pandar40P, level on the roof."""

    rate_hz: Annotated[float, msgspec.Meta(ge=1.0, le=50.0)] = 10.0
    """Turns a second, Hz."""
    columns: Annotated[int, msgspec.Meta(ge=36, le=7200)] = 1800
    """Firings of all lasers a turn (0.2 deg at 10 Hz)."""
    place: Vector3 = (0.0, 0.0, 1.4)
    """Its place on the vehicle, m, body frame; its axes are the body's."""
    range_min_m: NonNegative = 0.3
    """Nearest return, m."""
    range_max_m: Annotated[float, msgspec.Meta(gt=0.0, le=500.0)] = 200.0
    """Farthest return, m; it has just that from ten percent of reflectivity, met head on."""
    range_sigma_m: NonNegative = 0.02
    """Noise of a range, one sigma, m."""
    echo_sigma: NonNegative = 0.3
    """Noise of the logarithm of an echo's strength (one sigma): whether a faint one is heard, -."""
    intensity_sigma: NonNegative = 0.1
    """Noise of an intensity, as a share of it, -."""
    dropped_fraction: Fraction = 0.002
    """Share of the returns that are lost for no reason, -."""
    delay_s: NonNegative = 0.01
    """From the end of a turn to its arrival, s."""

    def __post_init__(self) -> None:
        check_order(self, "range_min_m", "range_max_m")
