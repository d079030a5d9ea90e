"""GTSAM (ISAM2 over preintegrated IMU) as an independent oracle on a simulated log."""

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.config import Gates
from fusion.sensor_models import ImuNoise
from fusion.state import ERROR_SIZE
from fusion.timeline import noise_of
from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.geodesy import enu_from_llh
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate_drive
from sensors.vehicle import ImuSpec, Vehicle
from tests.fusion.free import HONEST_FREE, Floats, core_at, go, nav_of

SECONDS = 60.0
PRIOR = {"attitude": 0.01, "position": 0.05, "velocity": 0.1, "gyro bias": 2e-4, "accel bias": 0.02}
SPEC = ImuSpec(gyro_turn_on_bias_deg_per_h=30.0, accel_turn_on_bias_mg=1.0)


@pytest.fixture(scope="module")
def gtsam() -> Any:
    return pytest.importorskip("gtsam", reason="needs the bench extra: pip install egoloc[bench]")


def filtered(log: Log, nav: Floats) -> tuple[Floats, Floats]:
    """(N, 3) ENU positions and sigmas of the kernel filter after every GNSS epoch, from a given first state."""
    assert log.imu is not None
    order = ("position", "velocity", "attitude", "gyro bias", "accel bias")
    P = np.diag(np.append(np.repeat([PRIOR[name] for name in order], 3), 0.0) ** 2)
    core = core_at(nav, log.imu, P)
    config = msgspec.structs.replace(HONEST_FREE, gates=Gates(use=False), output_hz=10.0)
    rec, _ = go(core, log.imu, log.vehicle, config, log)
    n = int(rec.filled[0])
    assert rec.sigma_state.shape[1] == ERROR_SIZE - 1
    return enu_from_llh(rec.nav[:n, :3], nav[:3]), rec.sigma_state[:n, :3]


def smoothed(gtsam: Any, log: Log, nav: Floats) -> Floats:
    """(N, 3) ENU positions of ISAM2 at every GNSS epoch, each from the data up to it."""
    assert log.imu is not None
    assert log.gnss is not None
    X, V, B = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B
    noise = noise_of(log.vehicle.imu, ImuNoise(noise_scale=1.0))
    lat, height = float(nav[0]), float(nav[2])
    north, up = gravity_enu(np.sin(lat), np.cos(lat), height)
    params = gtsam.PreintegrationParams(np.array([0.0, north, up]))
    params.setAccelerometerCovariance(np.eye(3) * noise.accel_psd)
    params.setGyroscopeCovariance(np.eye(3) * noise.gyro_psd)
    params.setIntegrationCovariance(np.eye(3) * 1e-10)
    params.setOmegaCoriolis(np.array([0.0, EARTH_RATE * np.cos(lat), EARTH_RATE * np.sin(lat)]))
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    step_s = 0.1
    drift = np.sqrt(step_s * np.repeat([noise.accel_bias_rate, noise.gyro_bias_rate], 3))
    walk = sigmas(drift)

    options = gtsam.ISAM2Params()
    options.setRelinearizeThreshold(1e-3)
    options.relinearizeSkip = 1
    isam, graph, values = gtsam.ISAM2(options), gtsam.NonlinearFactorGraph(), gtsam.Values()
    bias = gtsam.imuBias.ConstantBias()
    rotation = gtsam.Rot3(Rotation.from_quat(nav[6:10]).as_matrix())
    state = gtsam.NavState(rotation, np.zeros(3), nav[3:6])
    graph.addPriorPose3(X(0), state.pose(), sigmas(np.repeat([PRIOR["attitude"], PRIOR["position"]], 3)))
    graph.addPriorVector(V(0), state.velocity(), sigmas(np.repeat(PRIOR["velocity"], 3)))
    graph.addPriorConstantBias(B(0), bias, sigmas(np.repeat([PRIOR["accel bias"], PRIOR["gyro bias"]], 3)))
    _insert(gtsam, values, 0, state, bias)
    places = enu_from_llh(log.gnss.llh, nav[:3])
    found = []
    pim = gtsam.PreintegratedImuMeasurements(params, bias)
    # a sample of a rate is the mean of its interval best at its middle: average the ends
    gyro = 0.5 * (log.imu.gyro[1:] + log.imu.gyro[:-1])
    accel = 0.5 * (log.imu.accel[1:] + log.imu.accel[:-1])
    for k in range(1, len(log.gnss)):
        for i in range(10 * (k - 1), 10 * k):
            pim.integrateMeasurement(accel[i], gyro[i], 0.01)
        graph.add(gtsam.ImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), pim))
        graph.add(gtsam.BetweenFactorConstantBias(B(k - 1), B(k), gtsam.imuBias.ConstantBias(), walk))
        graph.add(gtsam.GPSFactor(X(k), places[k], gtsam.noiseModel.Gaussian.Covariance(log.gnss.cov_enu[k])))
        state = pim.predict(state, bias)
        _insert(gtsam, values, k, state, bias)
        isam.update(graph, values)
        isam.update()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = isam.calculateEstimatePose3(X(k))
        bias = isam.calculateEstimateConstantBias(B(k))
        state = gtsam.NavState(pose, isam.calculateEstimateVector(V(k)))
        found.append(np.asarray(pose.translation()))
        pim.resetIntegrationAndSetBias(bias)
    return np.array(found)


def _insert(gtsam: Any, values: Any, k: int, state: Any, bias: Any) -> None:
    symbol = gtsam.symbol_shorthand
    values.insert(symbol.X(k), state.pose())
    values.insert(symbol.V(k), state.velocity())
    values.insert(symbol.B(k), bias)


@pytest.mark.slow
def test_positions_agree_with_isam2(gtsam: Any) -> None:
    """One minute of 10 Hz GNSS with white errors: both see the same data and the same prior.

    GTSAM works in one plane and takes the attitude of each keyframe; what differs must be small against the noise that
    both share.
    """
    scene = msgspec.structs.replace(scenarios.load("clean"), vehicle=Vehicle(imu=SPEC))
    drive = simulate_drive(SECONDS, 61, scene)
    log = Log(imu=drive.log.imu, gnss=drive.log.gnss, vehicle=drive.log.vehicle)
    assert log.imu is not None
    assert log.gnss is not None
    motion = drive.truth.at(log.imu.t_ns[:1])
    nav = nav_of(motion)
    ours, sigma = filtered(log, nav)
    theirs = smoothed(gtsam, log, nav)
    assert ours.shape == theirs.shape
    true = enu_from_llh(drive.truth.at(log.gnss.t_ns[1:]).llh, nav[:3])
    apart = (ours - theirs) / sigma
    rms = [float(np.sqrt(((x - true) ** 2).sum(axis=1).mean())) for x in (ours, theirs)]
    print(f"apart: RMS {np.sqrt((apart**2).mean()):.3f} sigma, largest {np.abs(apart).max():.3f} sigma")
    print(f"error RMS in 3-D: ours {rms[0] * 100:.2f} cm, gtsam {rms[1] * 100:.2f} cm")
    assert np.sqrt((apart**2).mean()) < 0.1
    assert np.abs(apart).max() < 0.5
    assert rms[0] == pytest.approx(rms[1], rel=0.05)
