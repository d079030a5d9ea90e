"""Every number of the simulated GNSS receiver."""

import msgspec

from sensors.bounds import Fraction, NonNegative, Positive


class GnssSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An RTK receiver. Rates are those under any sky; an environment's Sky adds its own."""

    use: bool = True
    """Simulate GNSS at all."""
    rate_hz: Positive = 10.0
    """Rate of positions and velocities, Hz."""
    delay_s: NonNegative = 0.05
    """From measurement to arrival, s."""
    jitter_s: NonNegative = 0.002
    """Standard deviation of that delay, s."""
    float_per_hour: NonNegative = 18.0
    """How often a fixed solution falls back to float, 1/h."""
    float_s: Positive = 6.0
    """Mean length of a float stretch, s."""
    lost_per_hour: NonNegative = 12.0
    """How often the solution is lost, 1/h."""
    lost_s: Positive = 5.0
    """Mean length of a loss, without any message, s."""
    refix_s: Positive = 4.0
    """Mean time in float after a loss, a blocked stretch or a jump by reflections, s."""
    wrong_fix_per_hour: NonNegative = 0.0
    """How often ambiguities are fixed wrongly: the status says fixed, the sigma too, 1/h."""
    wrong_fix_s: Positive = 30.0
    """Mean time until a wrong fix is noticed and done again, if nothing breaks it before, s."""
    wrong_fix_m: Positive = 1.5
    """Standard deviation of a wrong fix's offset, each horizontal axis, m."""
    multipath_s: Positive = 4.0
    """Mean length of a jump by reflections, in float with float's sigma; how far and how often is the Sky's, s."""
    multipath_doppler: NonNegative = 0.02
    """Standard deviation of the velocity's error meanwhile, each axis, as a share of the speed, -."""
    fixed_sigma_m: Positive = 0.015
    """Fixed solution, each horizontal axis, m."""
    float_sigma_m: Positive = 0.4
    """Float solution, each horizontal axis, m."""
    vertical_ratio: Positive = 1.8
    """Vertical sigma over horizontal sigma, -."""
    correlated_fraction: Fraction = 0.7
    """Share of the position's variance that is correlated in time; 0: white errors, -."""
    correlation_s: NonNegative = 30.0
    """Correlation time of that share (first-order Gauss-Markov), s."""
    velocity_sigma: Positive = 0.03
    """Each horizontal axis of velocity, white, m/s."""
    velocity_vertical_sigma: Positive = 0.05
    """Vertical velocity, white, m/s."""
    dual_antenna: bool = False
    """Fixed solutions carry a heading from a second antenna."""
    yaw_sigma_deg: Positive = 0.2
    """That heading, white, deg."""
