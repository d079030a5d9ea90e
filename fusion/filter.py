"""Streaming filter: records in, states out, over the same kernels as the batch run and bit-identical to it.

Measurements are applied in stamp order: each waits until the IMU has passed its time, and one that is older than the
state is not applied (arrival order, with rewinding, is a matter of ordering and lives outside the core).
"""

from fusion.config import FusionConfig
from fusion.navigator import Navigator
from fusion.result import Decisions, States
from fusion.state import C_STATE, Core, Floats
from sensors.geodesy import MapFrame
from sensors.records import GnssFix, GnssVelocity, Imu, Log, PoseFix, WheelSpeed
from sensors.vehicle import Vehicle

Measurement = GnssFix | GnssVelocity | PoseFix | WheelSpeed

_KEPT_S = 60.0
"""IMU samples kept while not aligned, for measurements that come late, s."""
_NAMES = {Imu: "imu", GnssFix: "gnss", GnssVelocity: "gnss_velocity", PoseFix: "pose_fixes", WheelSpeed: "wheel"}


class Localizer:
    """Push records of one or more rows as they come; read ``core`` or take the recorded states and decisions.

    States are recorded on multiples of the output period, as ``fusion.run`` does; rows count pushed measurements of
    each sensor from zero, in the order of pushing. A measurement with the stamp of an IMU sample goes before it.
    """

    def __init__(
        self, vehicle: Vehicle | None = None, map_frame: MapFrame | None = None, config: FusionConfig | None = None
    ) -> None:
        self._navigator = Navigator(vehicle or Vehicle(), map_frame, config or FusionConfig(), _KEPT_S)

    @property
    def core(self) -> Core | None:
        """The filter's state; None before alignment."""
        return self._navigator.core

    @property
    def t_ns(self) -> int | None:
        """Time of the state; None before alignment."""
        return None if self.core is None else int(self.core.clock[C_STATE])

    def push(self, record: Imu | Measurement) -> None:
        """Take an IMU record or a measurement. IMU stamps must rise; raises EgolocError where they do not."""
        self._navigator.add(Log(**{_NAMES[type(record)]: record}))  # type: ignore[arg-type]
        if isinstance(record, Imu):
            self._navigator.advance(self._navigator.last_imu_ns)

    def take_states(self) -> States:
        """States recorded since the last call."""
        return self._navigator.take_states()

    def take_decisions(self) -> Decisions:
        """Decisions since the last call, in the order of application."""
        return self._navigator.take_decisions()

    def covariance(self) -> Floats | None:
        """(n, n) covariance at the last use of P (a measurement or a recorded state), None before alignment.

        n: the sixteen states of ``fusion.state`` and the configuration's blocks (``fusion.layout``).
        """
        count = self._navigator.state_count
        return None if self.core is None else self.core.P[:count, :count].copy()
