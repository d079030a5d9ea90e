"""What the other filters get of a drive: plain arrays in one ENU plane, both fixes at every tenth IMU sample."""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusion.covariance import Noise
from fusion.sensor_models import ImuNoise
from fusion.timeline import noise_of
from sensors.geodesy import enu_from_llh, llh_from_map, rotation_map_enu
from sensors.records import Log
from sensors.simulate.drive import Drive, simulate_drive
from sensors.simulate.scenarios import load

Floats = NDArray[np.float64]

EVERY = 10
"""IMU samples from fix to fix."""
GRAVITY = 9.807
"""At the start of the drive, m/s^2."""
SIGMA = {"position": 0.05, "velocity": 0.1, "tilt": 0.05, "yaw": 0.01, "gyro bias": 2e-3, "accel bias": 0.05}
"""Of the first state, at rest: m, m/s, rad, rad/s, m/s^2."""


@dataclass(frozen=True, slots=True, eq=False)
class PeerDrive:
    """datum: (3,) llh of the ENU plane; gyro, accel: (N, 3) FLU, dt s apart; K fixes, the first at the first sample:
    antenna (K, 3) ENU m with antenna_cov (3, 3); pose (K, 3) east m, north m, yaw rad with pose_cov (K, 3, 3);
    arm: (3,) antenna in body axes, m; noise: of the IMU's datasheet; truth: (K, 3) ENU m of the IMU, for tests."""

    datum: Floats
    gyro: Floats
    accel: Floats
    dt: float
    antenna: Floats
    antenna_cov: Floats
    pose: Floats
    pose_cov: Floats
    arm: Floats
    noise: Noise
    truth: Floats

    def middle(self, steps: int) -> tuple[Floats, Floats]:
        """(steps, 3) gyro and accel, the mean of the samples at both ends of each step."""
        gyro, accel = self.gyro[: steps + 1], self.accel[: steps + 1]
        return (gyro[1:] + gyro[:-1]) / 2.0, (accel[1:] + accel[:-1]) / 2.0

    def bias_walk(self) -> tuple[float, float]:
        """Variance per second of the drifting gyro and accelerometer biases."""
        return self.noise.gyro_bias_rate, self.noise.accel_bias_rate


def peer_drive(seconds: float) -> PeerDrive:
    """The benchmark's drive with the pose fixes on the stamps of GNSS, so that no peer needs two updates for them."""
    scenario = load("clean")
    together = msgspec.structs.replace(scenario.pose_fix, phase_s=0.0)
    return flat(simulate_drive(seconds, scenario.seed, msgspec.structs.replace(scenario, pose_fix=together)))


def flat(drive: Drive) -> PeerDrive:
    """A simulated drive, flattened."""
    log = drive.log
    assert log.imu is not None
    assert log.gnss is not None
    assert log.pose_fixes is not None
    assert np.array_equal(log.gnss.t_ns, log.imu.t_ns[::EVERY])
    assert np.array_equal(log.gnss.t_ns, log.pose_fixes.t_ns)
    datum = log.gnss.llh[0]
    pose = _pose_enu(log, datum)
    return PeerDrive(
        datum=datum,
        gyro=log.imu.gyro,
        accel=log.imu.accel,
        dt=float(log.imu.t_ns[1] - log.imu.t_ns[0]) * 1e-9,
        antenna=enu_from_llh(log.gnss.llh, datum),
        antenna_cov=log.gnss.cov_enu[0],
        pose=pose,
        pose_cov=log.pose_fixes.cov,
        arm=np.array(log.vehicle.gnss_lever_arm),
        noise=noise_of(log.vehicle.imu, ImuNoise(noise_scale=1.0)),
        truth=enu_from_llh(drive.truth.at(log.gnss.t_ns).llh, datum),
    )


def _pose_enu(log: Log, datum: Floats) -> Floats:
    """(K, 3) pose fixes in the ENU plane: east m, north m, yaw rad."""
    assert log.gnss is not None
    assert log.pose_fixes is not None
    assert log.map_frame is not None
    pose = log.pose_fixes.pose
    llh = llh_from_map(log.map_frame, np.column_stack((pose[:, :2], log.gnss.llh[:, 2])))
    R_map_enu = rotation_map_enu(log.map_frame, llh)[0]
    yaw = pose[:, 2] - np.arctan2(R_map_enu[:, 1, 0], R_map_enu[:, 0, 0])
    return np.column_stack((enu_from_llh(llh, datum)[:, :2], yaw))
