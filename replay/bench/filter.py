"""`egoloc bench filter`: IMU steps per second of the whole filter, beside filterpy and gtsam in the same run.

One simulated drive: 100 Hz IMU, 10 Hz GNSS positions, 10 Hz pose fixes. egoloc's figures are whole calls of ``fusion.run``
(covariances, sorting, alignment, recording included). The peers have less to do, on a flat earth and without gates, lever
arms or records: filterpy's KalmanFilter in the usual numpy loop, and gtsam's ISAM2 with a keyframe at every pose fix.
"""

from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig, MotionModel
from fusion.run import run as fuse
from fusion.timeline import noise_of
from replay.bench.measure import conditions, rate, times
from sensors.geodesy import enu_from_llh
from sensors.records import Log
from sensors.simulate.drive import simulate_drive
from sensors.simulate.scenarios import load

METRIC = "imu_steps_per_s"
_PEER_STEPS = {"filterpy": 5_000, "gtsam": 20_000}
Floats = NDArray[np.float64]


def run(repeats: int = 5, seconds: float = 1800.0) -> dict[str, Any]:
    """Medians over repeats of a drive of so many seconds."""
    scenario = load("clean")
    whole = simulate_drive(seconds, scenario.seed, scenario).log
    log = replace(whole, gnss_velocity=None, wheel=None, reference=None)
    assert log.imu is not None
    assert whole.imu is not None
    plain = msgspec.structs.replace(FusionConfig(), motion=MotionModel(zero_velocity=False, non_holonomic=False))
    steps = len(log.imu)
    rows = [
        rate("egoloc", METRIC, steps, times(lambda: fuse(log, plain), repeats)),
        rate("egoloc, all sensors and constraints", METRIC, steps, times(lambda: fuse(whole), repeats)),
        rate("filterpy", METRIC, _PEER_STEPS["filterpy"], times(lambda: filterpy_loop(log), min(repeats, 3))),
    ]
    if find_spec("gtsam"):
        rows.append(rate("gtsam", METRIC, _PEER_STEPS["gtsam"], times(lambda: gtsam_loop(log), min(repeats, 3))))
    median = {r["name"]: r["median"] for r in rows}
    ratios = {peer: median["egoloc"] / median[peer] for peer in ("filterpy", "gtsam") if peer in median}
    packages = ["numba", "numpy", "filterpy", *(["gtsam"] if "gtsam" in median else [])]
    facts = {"seconds": seconds, "imu_hz": 100, "gnss_hz": 10, "pose_hz": 10, "states": 15, "peer_steps": _PEER_STEPS}
    return {"bench": "filter", "rows": rows, "ratios": ratios, "conditions": conditions(packages, cores=1, **facts)}


def filterpy_loop(log: Log) -> Floats:
    """A 15-state error-state filter around filterpy.KalmanFilter: the usual numpy loop, flat earth; last position ENU m."""
    from filterpy.kalman import KalmanFilter
    from scipy.spatial.transform import Rotation

    assert log.imu is not None
    assert log.gnss is not None
    assert log.pose_fixes is not None
    steps, dt = _PEER_STEPS["filterpy"], 0.01
    accel, gyro = log.imu.accel, log.imu.gyro
    places = enu_from_llh(log.gnss.llh[: steps // 10 + 2], log.gnss.llh[0])
    noise, gravity = noise_of(log.vehicle.imu, 1.0), np.array([0.0, 0.0, -9.81])
    kf = KalmanFilter(dim_x=15, dim_z=3)
    kf.P = np.diag([1.0] * 3 + [1.0] * 3 + [0.1] * 3 + [1e-4] * 3 + [1e-2] * 3)
    Q = np.diag([0.0] * 3 + [noise.accel_psd * dt] * 3 + [noise.gyro_psd * dt] * 3 + [1e-12] * 3 + [1e-9] * 3)
    F, H_gnss, H_pose = np.eye(15), np.eye(3, 15), np.zeros((3, 15))
    F[0:3, 3:6] = np.eye(3) * dt
    H_pose[0, 0] = H_pose[1, 1] = H_pose[2, 8] = 1.0
    R_gnss, R_pose = np.eye(3) * 4e-4, np.diag([2.5e-3, 2.5e-3, 1e-5])
    p, v, bg, ba = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    R = Rotation.from_euler("z", log.pose_fixes.pose[0, 2]).as_matrix()
    for step in range(steps):
        force = R @ (accel[step] - ba)
        p = p + v * dt
        v = v + (force + gravity) * dt
        F[3:6, 6:9] = -dt * _skew(force)
        F[3:6, 12:15] = F[6:9, 9:12] = -dt * R
        R = R @ Rotation.from_rotvec((gyro[step] - bg) * dt).as_matrix()
        kf.predict(F=F, Q=Q)
        if step % 10:
            continue
        pose = log.pose_fixes.pose[step // 10]
        place = places[step // 10]
        yaw = pose[2] - np.arctan2(R[1, 0], R[0, 0])
        for z, H, R_z in (
            (place - p, H_gnss, R_gnss),
            (np.array([place[0] - p[0], place[1] - p[1], np.arctan2(np.sin(yaw), np.cos(yaw))]), H_pose, R_pose),
        ):
            kf.x = np.zeros((15, 1))
            kf.update(z[:, None], R=R_z, H=H)
            dx = kf.x[:, 0]
            p, v, bg, ba = p + dx[0:3], v + dx[3:6], bg + dx[9:12], ba + dx[12:15]
            R = Rotation.from_rotvec(dx[6:9]).as_matrix() @ R
    return p


def _skew(v: Floats) -> Floats:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def gtsam_loop(log: Log) -> Floats:
    """ISAM2 with a keyframe at every pose fix, preintegration between, GNSS and pose fixes as factors; last position."""
    import gtsam

    assert log.imu is not None
    assert log.gnss is not None
    assert log.pose_fixes is not None
    steps = _PEER_STEPS["gtsam"]
    noise = noise_of(log.vehicle.imu, 1.0)
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.eye(3) * noise.accel_psd)
    params.setGyroscopeCovariance(np.eye(3) * noise.gyro_psd)
    params.setIntegrationCovariance(np.eye(3) * 1e-9)
    bias = gtsam.imuBias.ConstantBias()
    pim = gtsam.PreintegratedImuMeasurements(params, bias)
    isam = gtsam.ISAM2()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    X, V, B = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B
    places = enu_from_llh(log.gnss.llh[: steps // 10 + 2], log.gnss.llh[0])
    state = gtsam.NavState(gtsam.Rot3.Yaw(float(log.pose_fixes.pose[0, 2])), gtsam.Point3(*places[0]), np.zeros(3))
    _gtsam_insert(values, 0, state, bias)
    graph.addPriorPose3(X(0), state.pose(), gtsam.noiseModel.Diagonal.Sigmas([0.02, 0.02, 0.01, 0.1, 0.1, 0.1]))
    graph.addPriorVector(V(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.1))
    graph.addPriorConstantBias(B(0), bias, gtsam.noiseModel.Isotropic.Sigma(6, 0.05))
    gnss_noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.02)
    walk = gtsam.noiseModel.Diagonal.Sigmas([1e-4] * 3 + [1e-6] * 3)
    pose_noise = gtsam.noiseModel.Diagonal.Sigmas([1.0, 1.0, 0.01, 0.1, 0.1, 1.0])
    accel, gyro = log.imu.accel, log.imu.gyro
    for step in range(steps):
        pim.integrateMeasurement(accel[step], gyro[step], 0.01)
        if (step + 1) % 10:
            continue
        k = (step + 1) // 10
        graph.add(gtsam.ImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), pim))
        graph.add(gtsam.BetweenFactorConstantBias(B(k - 1), B(k), gtsam.imuBias.ConstantBias(), walk))
        state = pim.predict(state, bias)
        graph.add(gtsam.GPSFactor(X(k), gtsam.Point3(*places[k]), gnss_noise))
        yaw = gtsam.Rot3.Yaw(float(log.pose_fixes.pose[k, 2]))
        graph.addPriorPose3(X(k), gtsam.Pose3(yaw, gtsam.Point3(*places[k])), pose_noise)
        _gtsam_insert(values, k, state, bias)
        isam.update(graph, values)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        estimate = isam.calculateEstimatePose3(X(k)), isam.calculateEstimateVector(V(k))
        bias = isam.calculateEstimateConstantBias(B(k))
        state = gtsam.NavState(estimate[0], estimate[1])
        pim.resetIntegrationAndSetBias(bias)
    return np.asarray(state.position())


def _gtsam_insert(values: Any, k: int, state: Any, bias: Any) -> None:
    import gtsam

    X, V, B = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B
    values.insert(X(k), state.pose())
    values.insert(V(k), state.velocity())
    values.insert(B(k), bias)
