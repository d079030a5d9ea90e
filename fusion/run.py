"""Fusing a drive: a Session takes it in pieces, ``run`` in one."""

from dataclasses import replace

import numpy as np

from fusion.calibration import estimates
from fusion.config import FusionConfig
from fusion.navigator import Navigator
from fusion.recording import join
from fusion.result import FusionResult, Reason
from fusion.rewinding import RewindingNavigator
from fusion.sources import RECORDS
from fusion.state import FOREVER, NEVER
from fusion.tape import Tape
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.pieces import summed
from sensors.records import LeftOut, Log
from sensors.vehicle import Vehicle

_START_NS = 60 * NS_PER_S
"""Measurements older than this cannot help an IMU that has not begun yet."""


class Session:
    """A drive in stamp order, piece by piece (``sensors.pieces``): the same bits however it is cut.

    Results follow the pieces: the IMU is held back by the largest delay of the vehicle's GNSS, whose measurements are
    true before their stamps. A measurement that a piece brings after the state has passed it is LATE. What waits in
    memory is the last piece, and measurements since the last IMU sample.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        map_frame: MapFrame | None = None,
        config: FusionConfig | None = None,
        tape: Tape | None = None,
    ) -> None:
        """tape: takes down what ``fusion.smoother`` needs."""
        self._vehicle, self._config = vehicle, config or FusionConfig()
        if self._config.order == "arrival":
            if tape is not None:
                raise EgolocError('fusion.order: expected "stamp" to smooth a drive, got "arrival"')
            self._navigator: Navigator = RewindingNavigator(vehicle, map_frame, self._config)
        else:
            self._navigator = Navigator(vehicle, map_frame, self._config, tape=tape)
        self._held_ns = max(0, *(round(s * 1e9) for s in (vehicle.gnss_delay_s, vehicle.gnss_velocity_delay_s)))
        self._samples = 0

    def push(self, piece: Log) -> FusionResult:
        """Take the next piece; returns what was decided by now.

        Raises EgolocError for pose fixes without a map frame and for IMU stamps that do not rise.
        """
        navigator = self._navigator
        before, spikes = navigator.last_imu_ns if self._samples else None, navigator.spikes.held_back
        navigator.add(piece)
        self._samples += 0 if piece.imu is None else len(piece.imu)
        if not self._samples:
            navigator.decide(Reason.BEFORE_ALIGNMENT, _last_stamp(piece) - _START_NS)
        else:
            navigator.advance(navigator.last_imu_ns - self._held_ns)
        return self._result((*self._gaps(piece, before), *_spikes(navigator.spikes.held_back - spikes)))

    def finish(self) -> FusionResult:
        """The rest of the drive. Raises EgolocError if it had no IMU."""
        if self._samples < 2:
            raise EgolocError("the log has no IMU samples: expected sensor_msgs/msg/Imu on a topic")
        self._navigator.advance(FOREVER)
        aligned = self._navigator.core is not None
        self._navigator.decide(Reason.OUTSIDE_IMU if aligned else Reason.BEFORE_ALIGNMENT)
        found = estimates(self._navigator.core, self._vehicle, self._config)
        return replace(self._result(()), estimates=found)

    def _result(self, left_out: tuple[LeftOut, ...]) -> FusionResult:
        navigator = self._navigator
        states, decisions, restarts = navigator.take_states(), navigator.take_decisions(), navigator.take_restarts()
        return FusionResult(states, decisions, navigator.aligned_ns, left_out, restarts)

    def _gaps(self, piece: Log, before_ns: int | None) -> tuple[LeftOut, ...]:
        """Gaps in the IMU that end in this piece."""
        if piece.imu is None:
            return ()
        t = piece.imu.t_ns if before_ns is None else np.r_[before_ns, piece.imu.t_ns]
        gaps = int((np.diff(t) > self._config.imu.max_gap_s * 1e9).sum())
        return (LeftOut("imu", f"gap over {self._config.imu.max_gap_s:g} s, bridged or coasted", gaps),) if gaps else ()


def run(log: Log, config: FusionConfig | None = None) -> FusionResult:
    """Fuse a whole log in stamp order: a Session of one piece.

    States come on multiples of the output period, from alignment to the last IMU sample. Raises EgolocError for a log
    without IMU, or with pose fixes but no map frame.
    """
    if log.imu is None or len(log.imu) < 2:
        raise EgolocError("the log has no IMU samples: expected sensor_msgs/msg/Imu on a topic")
    session = Session(log.vehicle, log.map_frame, config)
    return joined([session.push(log), session.finish()])


def joined(results: list[FusionResult]) -> FusionResult:
    """The result of a drive from those of its pieces."""
    return FusionResult(
        join([result.states for result in results]),
        join([result.decisions for result in results]),
        results[-1].aligned_ns,
        summed(entry for result in results for entry in result.left_out),
        tuple(restart for result in results for restart in result.restarts),
        results[-1].estimates,
    )


def _spikes(count: int) -> tuple[LeftOut, ...]:
    return (LeftOut("imu", "spike, far from the samples before and after", count),) if count else ()


def _last_stamp(piece: Log) -> int:
    records = [record for name in RECORDS if (record := getattr(piece, name)) is not None and len(record)]
    return max((int(record.t_ns[-1]) for record in records), default=NEVER)
