"""Streaming filter: records in, states out, over the same kernels as the batch run and bit-identical to it.

In arrival order (for live use) a measurement is applied as soon as it comes and the IMU has reached its time, late ones
by rewinding. In stamp order each waits until the IMU has passed its time, and one that is older than the state is not
applied.
"""

from typing import NamedTuple

from fusion.axes import with_lean
from fusion.calibration import estimates
from fusion.config import FusionConfig
from fusion.covariance import propagate
from fusion.navigator import Navigator
from fusion.result import Decisions, Estimated, Restart, States
from fusion.rewinding import RewindingNavigator
from fusion.state import ACCEL_BIAS, C_STATE, GYRO_BIAS, LLH, QUATERNION, VELOCITY, Core, Floats
from fusion.timeline import parameters
from sensors.geodesy import MapFrame
from sensors.records import GnssFix, GnssVelocity, Imu, Log, PoseFix, WheelSpeed
from sensors.vehicle import Vehicle

Measurement = GnssFix | GnssVelocity | PoseFix | WheelSpeed

_KEPT_S = 60.0
"""Stamp order: IMU samples kept while not aligned, for measurements that come late, s."""
_KEPT = 10_000
"""Arrival order: so many states and decisions are kept until they are taken."""
_NAMES = {Imu: "imu", GnssFix: "gnss", GnssVelocity: "gnss_velocity", PoseFix: "pose_fixes", WheelSpeed: "wheel"}


class State(NamedTuple):
    """The state at t_ns: llh (3,) rad, rad, m; vel_enu (3,) m/s; q_enu_body (4,) xyzw; gyro_bias (3,) rad/s;
    accel_bias (3,) m/s^2."""

    t_ns: int
    llh: Floats
    vel_enu: Floats
    q_enu_body: Floats
    gyro_bias: Floats
    accel_bias: Floats


class Localizer:
    """Push records of one or more rows as they come; ask for the state, take the recorded states and decisions.

    States are recorded on multiples of the output period, as ``fusion.run`` does; rows count pushed measurements of
    each sensor from zero, in the order of pushing. A measurement with the stamp of an IMU sample goes before it. In
    arrival order rows count as arrived when they are pushed, memory is constant, and of what is not taken the oldest is
    dropped after 10,000 states or decisions.
    """

    def __init__(
        self, vehicle: Vehicle | None = None, map_frame: MapFrame | None = None, config: FusionConfig | None = None
    ) -> None:
        vehicle, config = vehicle or Vehicle(), config or FusionConfig()
        self._vehicle, self._config = vehicle, config
        self._par = parameters(vehicle, config)
        self._navigator: Navigator
        if config.order == "arrival":
            self._navigator = RewindingNavigator(vehicle, map_frame, config, _KEPT)
        else:
            self._navigator = Navigator(vehicle, map_frame, config, _KEPT_S)

    @property
    def core(self) -> Core | None:
        """The filter's memory; None before alignment."""
        return self._navigator.core

    @property
    def t_ns(self) -> int | None:
        """Time of the state, that of the last IMU sample; None before alignment."""
        return None if self.core is None else int(self.core.clock[C_STATE])

    def push(self, record: Imu | Measurement) -> None:
        """Take an IMU record or a measurement. IMU stamps must rise; raises EgolocError where they do not."""
        self._navigator.push(Log(**{_NAMES[type(record)]: record}))  # type: ignore[arg-type]

    def state(self) -> State | None:
        """The state now, at the last IMU sample; None before alignment."""
        if self.core is None:
            return None
        nav = self.core.nav.copy()
        parts = (nav[LLH], nav[VELOCITY], nav[QUATERNION], nav[GYRO_BIAS], nav[ACCEL_BIAS])
        return State(int(self.core.clock[C_STATE]), *parts)

    def covariance(self) -> Floats | None:
        """(n, n) covariance of the state now; None before alignment.

        n: the sixteen states of ``fusion.state`` and the configuration's blocks (``fusion.layout``).
        """
        core = self.core
        if core is None:
            return None
        P, scratch = core.P.copy(), (core.phi, core.M, core.Mt)
        propagate(core.nav, core.earth, P, core.acc.copy(), core.span.copy(), scratch, self._par.noise)
        n = self._navigator.state_count
        return with_lean(P[:n, :n], core.nav, self._par.axes_var)

    def take_restarts(self) -> tuple[Restart, ...]:
        """Divergences since the last call after which alignment began anew."""
        return self._navigator.take_restarts()

    def estimates(self) -> tuple[Estimated, ...]:
        """What the drive has shown of the calibration by now (``fusion.calibration``)."""
        return estimates(self.core, self._vehicle, self._config)

    def take_states(self) -> States:
        """States recorded since the last call."""
        return self._navigator.take_states()

    def take_decisions(self) -> Decisions:
        """Decisions since the last call, in the order in which they were made."""
        return self._navigator.take_decisions()
