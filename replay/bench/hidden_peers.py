"""What the other filters get of a log over hidden stretches: arrays, with the same noise, lever arms and first state.

They begin as egoloc does: with its first state and the sigmas of that (its diagonal), and anew a second after every
pause in the IMU. Positions and velocities have the covariances that egoloc uses (floors and inflation), the IMU the
same white noise (datasheet times ``imu.noise_scale``); stamps are corrected by the vehicle's delays. They are told
where the vehicle stood, as egoloc found it with GNSS never hidden: better than any of them could find in a stretch.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.covariance import Noise
from fusion.result import Reason, Sensor, States
from fusion.run import run as fuse
from fusion.sources import APPLY, Sources, sources
from fusion.timeline import noise_of
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import Imu, Log

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

AGAIN_S = 1.0
"""After a pause in the IMU peers begin anew so much later."""


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """Measurements of one kind: t_ns (N,); value (N, 3); cov (N, 3, 3) ENU."""

    t_ns: Nanoseconds
    value: Floats
    cov: Floats


@dataclass(frozen=True, eq=False)
class PeerLog:
    """imu; positions (llh) and velocities (ENU) in order; arm, axle: (3,) m in body axes; noise of the IMU;
    states: what egoloc makes of the log with everything; rest_ns: motion ticks at rest; begin_ns: when to begin."""

    imu: Imu
    positions: Values
    velocities: Values
    wheel: Values
    arm: Floats
    axle: Floats
    noise: Noise
    states: States
    rest_ns: Nanoseconds
    begin_ns: Nanoseconds
    config: FusionConfig

    def first_state(self, t_ns: int) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """egoloc's state at or after t_ns: llh, velocity ENU, q_enu_body, gyro and accelerometer bias, sigma (15,)."""
        i = int(np.searchsorted(self.states.t_ns, t_ns))
        s = self.states
        return s.llh[i], s.vel_enu[i], s.q_enu_body[i], s.gyro_bias[i], s.accel_bias[i], s.sigma[i]

    @cached_property
    def bias_walk(self) -> tuple[float, float]:
        """Variance per second of the drifting gyro and accelerometer biases."""
        return self.noise.gyro_bias_rate, self.noise.accel_bias_rate


def peer_log(log: Log, config: FusionConfig) -> PeerLog:
    """The log as the peers read it."""
    assert log.imu is not None
    result = fuse(log, config)
    if result.aligned_ns is None:
        raise EgolocError("bench hidden: expected a log that gives a first state, this one never does")
    found = sources(log, config)
    decided = result.decisions
    rested = (decided.sensor == Sensor.ZERO_VELOCITY) & (decided.reason == Reason.ACCEPTED)
    pauses = np.flatnonzero(np.diff(log.imu.t_ns) > config.imu.max_gap_s * NS_PER_S)
    begin = np.r_[result.aligned_ns, log.imu.t_ns[pauses + 1] + round(AGAIN_S * NS_PER_S)]
    begin = np.unique(result.states.t_ns[np.searchsorted(result.states.t_ns, begin[begin < result.states.t_ns[-1]])])
    m = found.measurements
    return PeerLog(
        log.imu,
        _values(found, Sensor.GNSS_POSITION, m.gnss_llh, m.gnss_cov),
        _values(found, Sensor.GNSS_VELOCITY, m.vel, m.vel_cov),
        _values(found, Sensor.WHEEL, m.wheel[:, None], m.wheel_var[:, None, None]),
        np.array(log.vehicle.gnss_lever_arm),
        np.array(log.vehicle.rear_axle),
        noise_of(log.vehicle.imu, config.imu),
        result.states,
        decided.t_ns[rested],
        begin,
        config,
    )


def _values(found: Sources, sensor: Sensor, value: Floats, cov: Floats) -> Values:
    rows = (found.kind == sensor) & (found.verdict == APPLY)
    return Values(found.t_ns[rows], value[found.row[rows]], cov[found.row[rows]])
