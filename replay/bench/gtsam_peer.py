"""gtsam: preintegrated IMU between keyframes at every fix, in a fixed-lag smoother over ISAM2."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.bench.peers import EVERY, GRAVITY, SIGMA, PeerDrive

Floats = NDArray[np.float64]

LAG_S = 0.5
"""Keyframes older than this are marginalized: twice as fast as an ISAM2 graph that keeps them all, same positions."""
FREE_M = 100.0
FREE_RAD = 1.0
"""Sigmas of what a pose fix does not tell: height, roll and pitch."""


def track(drive: PeerDrive, steps: int) -> Floats:
    """(steps / EVERY, 3) ENU positions after each fix, m.

    ImuFactor and a random walk of the bias between keyframes, GPSFactorArm for GNSS, and for the pose fix a prior on
    the pose with roll, pitch and height left free; flat earth, no gates. ISAM2's defaults (Cholesky, relinearization
    at most every tenth update and above 0.1) gave the same positions as relinearizing at every one.
    """
    import gtsam

    X, V, B = _keys()
    gyro, accel = (list(column) for column in drive.middle(steps))
    bias = gtsam.imuBias.ConstantBias()
    pim = gtsam.PreintegratedImuMeasurements(_imu_noise(drive), bias)
    smoother = gtsam.IncrementalFixedLagSmoother(LAG_S, gtsam.ISAM2Params())
    graph, values, times = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.FixedLagSmootherKeyTimestampMap()
    yaw = gtsam.Rot3.Yaw(float(drive.pose[0, 2]))
    state = gtsam.NavState(yaw, drive.antenna[0] - yaw.matrix() @ drive.arm, np.zeros(3))
    _add_start(graph, state, bias)
    noises, no_change = _noises(drive), gtsam.imuBias.ConstantBias()
    found = []
    for k in range(steps // EVERY + 1):
        if k:
            for i in range(EVERY * (k - 1), EVERY * k):
                pim.integrateMeasurement(accel[i], gyro[i], drive.dt)
            graph.add(gtsam.ImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), pim))
            graph.add(gtsam.BetweenFactorConstantBias(B(k - 1), B(k), no_change, noises["walk"]))
            state = pim.predict(state, bias)
        graph.add(gtsam.GPSFactorArm(X(k), drive.antenna[k], drive.arm, noises["antenna"]))
        east, north, heading = drive.pose[k].tolist()
        seen = gtsam.Pose3(gtsam.Rot3.Yaw(heading), np.array([east, north, state.position()[2]]))
        graph.addPriorPose3(X(k), seen, noises["pose"])
        values.insert(X(k), state.pose())
        values.insert(V(k), state.velocity())
        values.insert(B(k), bias)
        for key in (X(k), V(k), B(k)):
            times.insert((key, k * EVERY * drive.dt))
        smoother.update(graph, values, times)
        graph.resize(0)
        values.clear()
        times.clear()
        bias = smoother.calculateEstimateConstantBias(B(k))
        state = gtsam.NavState(smoother.calculateEstimatePose3(X(k)), smoother.calculateEstimateVector(V(k)))
        pim.resetIntegrationAndSetBias(bias)
        found.append(state.position())
    return np.array(found[1:])


def _keys() -> tuple[Any, Any, Any]:
    from gtsam.symbol_shorthand import B, V, X

    return X, V, B


def _imu_noise(drive: PeerDrive) -> Any:
    import gtsam

    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    params.setAccelerometerCovariance(np.eye(3) * drive.noise.accel_psd)
    params.setGyroscopeCovariance(np.eye(3) * drive.noise.gyro_psd)
    params.setIntegrationCovariance(np.eye(3) * 1e-9)
    return params


def _noises(drive: PeerDrive) -> dict[str, Any]:
    """Noise of a bias's step, of the antenna's place and, in body axes, of a pose fix."""
    import gtsam

    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    gyro_walk, accel_walk = drive.bias_walk()
    along, across, yaw = np.sqrt(np.diagonal(_in_body(drive), axis1=1, axis2=2).mean(axis=0))
    return {
        "walk": sigmas(np.sqrt(EVERY * drive.dt * np.repeat([accel_walk, gyro_walk], 3))),
        "antenna": gtsam.noiseModel.Gaussian.Covariance(drive.antenna_cov),
        "pose": sigmas(np.array([FREE_RAD, FREE_RAD, yaw, along, across, FREE_M])),
    }


def _in_body(drive: PeerDrive) -> Floats:
    """(K, 3, 3) covariance of the pose fixes along, left and in yaw."""
    cosine, sine = np.cos(drive.pose[:, 2]), np.sin(drive.pose[:, 2])
    T = np.zeros_like(drive.pose_cov)
    T[:, 0, 0] = T[:, 1, 1] = cosine
    T[:, 0, 1], T[:, 1, 0] = sine, -sine
    T[:, 2, 2] = 1.0
    result: Floats = T @ drive.pose_cov @ T.transpose(0, 2, 1)
    return result


def _add_start(graph: Any, state: Any, bias: Any) -> None:
    """Priors on the first keyframe."""
    import gtsam

    X, V, B = _keys()
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    pose = [SIGMA["tilt"], SIGMA["tilt"], SIGMA["yaw"], *[SIGMA["position"]] * 3]
    graph.addPriorPose3(X(0), state.pose(), sigmas(np.array(pose)))
    graph.addPriorVector(V(0), state.velocity(), sigmas(np.full(3, SIGMA["velocity"])))
    graph.addPriorConstantBias(B(0), bias, sigmas(np.repeat([SIGMA["accel bias"], SIGMA["gyro bias"]], 3)))
