"""Every number of the simulated map matching."""

from typing import Annotated, Literal

import msgspec

from sensors.bounds import Fraction, NonNegative, Positive, check_order
from sensors.errors import EgolocError

Offset = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]


class PoseFixSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Map matching: sharp across the road, less so along it, blind along it where no landmark stands.

    Environments say how often a drive meets degenerate stretches and look-alikes (Landmarks).
    """

    use: bool = True
    """Simulate pose fixes at all."""
    rate_hz: Positive = 10.0
    """Rate of the fixes, Hz."""
    phase_s: NonNegative = 0.03
    """First fix after the start (cameras do not share the IMU's clock), s."""
    delay_s: NonNegative = 0.12
    """From exposure to the fix's arrival, s."""
    jitter_s: NonNegative = 0.003
    """Standard deviation of that delay, s."""
    longitudinal_min_m: Positive = 0.03
    """Longitudinal sigma among many landmarks, m."""
    longitudinal_max_m: Positive = 0.10
    """Longitudinal sigma among few landmarks, m."""
    longitudinal_scale_m: Positive = 80.0
    """Distance over which the longitudinal sigma changes, m."""
    lateral_m: Positive = 0.03
    """Median of the lateral sigma, m."""
    lateral_spread: NonNegative = 0.0
    """Standard deviation of the logarithm of the lateral sigma along the road, -."""
    yaw_deg: Positive = 0.13
    """Median of the yaw sigma, deg."""
    yaw_spread: NonNegative = 0.0
    """Standard deviation of the logarithm of the yaw sigma along the road, -."""
    spread_scale_m: Positive = 200.0
    """Distance over which the lateral and yaw sigmas change, m."""
    yaw_offset_deg: Offset = 0.0
    """Constant yaw error (camera against body, as left over by calibration); the stated sigma covers it, deg."""
    night_factor: Positive = 1.0
    """All sigmas at night, times those by day, -."""

    blind_per_hour: NonNegative = 24.0
    """How often the longitudinal direction is not observed, with the covariance to match, 1/h."""
    blind_min_s: Positive = 3.0
    """Shortest of these stretches, s."""
    blind_max_s: Positive = 9.0
    """Longest of these stretches, s."""
    blind_sigma_min_m: Positive = 0.5
    """Smallest longitudinal sigma there, m."""
    blind_sigma_max_m: Positive = 0.9
    """Largest longitudinal sigma there, m."""

    window_sigmas_m: tuple[Positive, Positive, Positive] = (1.87, 0.94, 0.47)
    """Sigma of a flat histogram at levels 0, 1, 2: where it saturates on a degenerate stretch, m."""
    flat_shares: tuple[Fraction, Fraction, Fraction] = (0.3, 0.3, 0.4)
    """How often a degenerate stretch is flat from level 0, 1, 2 on; relative, -."""
    prior_drift: NonNegative = 0.015
    """There the mean is the prior's, whose error grows by this (one sigma) a metre, within the window, m/m."""

    dash_pitch_m: Positive = 6.0
    """Repeat of lane dashes (2 m line, 4 m gap: GB 5768.3 below 60 km/h), m."""
    lane_width_m: Positive = 3.5
    """From a lane to the next, m."""
    alias_m: Positive = 15.0
    """Mean length of a stretch matched one dash or one lane off, m."""

    alias_modes_fraction: Fraction = 0.5
    """Share of these stretches whose fixes tell both modes, the wrong one as the stronger, -."""
    alias_covariance: Literal["both", "one"] = "both"
    """The stated covariance there: that of both modes, or of the stronger alone (a finest level sees no other)."""

    gross_per_hour: NonNegative = 0.0
    """How often a frame locks onto something else altogether, with the usual covariance, 1/h."""
    gross_yaw_min_deg: NonNegative = 8.0
    """Smallest yaw error then, deg."""
    gross_yaw_max_deg: NonNegative = 16.0
    """Largest yaw error then, deg."""
    gross_longitudinal_m: NonNegative = 1.0
    """Standard deviation of the longitudinal error then, m."""
    gross_s: Positive = 0.5
    """Mean length of a gross error, s."""

    correlated_fraction: Fraction = 0.3
    """Share of each variance that is correlated in time; 0: none, -."""
    correlation_s: NonNegative = 2.0
    """Correlation time of that share, s."""
    map_fraction: Fraction = 0.0
    """Share of each variance that is the map's, the same whenever the road is driven, -."""
    feature_fraction: Fraction = 0.0
    """Share of each variance that is bound to the place in this drive (what is seen there), -."""
    feature_scale_m: Positive = 300.0
    """Correlation length of that share, m. The rest is white."""

    dropped_fraction: Fraction = 0.0
    """Single frames without a fix, -."""
    burst_per_hour: NonNegative = 0.0
    """How often several frames on end have none, 1/h."""
    burst_s: Positive = 0.7
    """Mean length of such a burst, s."""

    def __post_init__(self) -> None:
        for name in ("longitudinal_{}_m", "blind_{}_s", "blind_sigma_{}_m", "gross_yaw_{}_deg"):
            check_order(self, name.format("min"), name.format("max"))
        parts = self.correlated_fraction + self.map_fraction + self.feature_fraction
        if parts > 1.0 + 1e-9:
            raise EgolocError(
                f"correlated_fraction + map_fraction + feature_fraction: expected at most 1, got {parts:g}"
            )
        if not sum(self.flat_shares):
            raise EgolocError("flat_shares: expected one above 0, got none")
