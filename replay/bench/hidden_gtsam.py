"""gtsam over hidden stretches: ISAM2 over keyframes at every position, a copy of it at every start.

ImuFactor and a random walk of the bias between keyframes, GPSFactorArm for positions, in the plane tangent at the first
position with its gravity and the earth's rotation; no gates. In a stretch keyframes follow every KEYFRAME_S, so that
the bias may walk, and the covariance at the end is ISAM2's marginal.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.bench.hidden_egoloc import Estimate, Estimates
from replay.bench.hidden_peers import PeerLog
from replay.bench.hidden_plan import Plan, Stretch
from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.clock import NS_PER_S
from sensors.geodesy import enu_from_llh, llh_from_enu, rotation_ecef_enu
from sensors.rotation import matrix_from_q

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

KEYFRAME_S = 1.0


def ends(drive: PeerLog, plan: Plan) -> Estimates:
    """The end of each of the plan's stretches."""
    found: Estimates = {}
    begins = [int(t) for t in drive.begin_ns] + [max(stretch.last_ns for stretch in plan.stretches) + 1]
    for begin, until in pairwise(begins):
        mine = [stretch for stretch in plan.stretches if begin <= stretch.start_ns < until]
        if mine:
            graph = Graph(drive, begin)
            for stretch in mine:
                graph.run(stretch.start_ns)
                found |= graph.hidden(stretch, plan.point)
    return found


class Graph:
    """The graph since a first state of egoloc's."""

    def __init__(self, drive: PeerLog, begin_ns: int) -> None:
        import gtsam
        from gtsam.symbol_shorthand import B, V, X

        self._drive, self._gtsam, self._keys = drive, gtsam, (X, V, B)
        self._datum = drive.positions.value[0]
        self._t_ns, self._k, self._next = (
            begin_ns,
            0,
            int(np.searchsorted(drive.positions.t_ns, begin_ns, side="right")),
        )
        self._antenna = enu_from_llh(drive.positions.value, self._datum)
        llh, velocity, q, gyro_bias, accel_bias, sigma = drive.first_state(begin_ns)
        R = self._plane(llh)
        pose = gtsam.Pose3(gtsam.Rot3(R @ matrix_from_q(q)), enu_from_llh(llh[None], self._datum)[0])
        self._state = gtsam.NavState(pose, R @ velocity)
        self._bias = gtsam.imuBias.ConstantBias(accel_bias, gyro_bias)
        self._params = _imu_params(gtsam, drive, self._datum)
        how = gtsam.ISAM2Params()
        how.setFactorization("QR")  # Cholesky, the default, finds this graph indeterminate
        self._isam = gtsam.ISAM2(how)
        graph = gtsam.NonlinearFactorGraph()
        sigmas = gtsam.noiseModel.Diagonal.Sigmas
        body = np.abs(pose.rotation().matrix().T) @ sigma[6:9]
        graph.addPriorPose3(X(0), pose, sigmas(np.concatenate((body, np.repeat(sigma[0:3].max(), 3)))))
        graph.addPriorVector(V(0), self._state.velocity(), sigmas(sigma[3:6]))
        graph.addPriorConstantBias(B(0), self._bias, sigmas(np.concatenate((sigma[12:15], sigma[9:12]))))
        self._isam.update(graph, self._values(0))

    def run(self, until_ns: int) -> None:
        """Take the positions before a time."""
        positions = self._drive.positions
        while self._next < len(positions.t_ns) and positions.t_ns[self._next] < until_ns:
            row, self._next = self._next, self._next + 1
            graph = self._gtsam.NonlinearFactorGraph()
            self._keyframe(graph, int(positions.t_ns[row]))
            noise = self._gtsam.noiseModel.Gaussian.Covariance(positions.cov[row])
            graph.add(self._gtsam.GPSFactorArm(self._keys[0](self._k), self._antenna[row], self._drive.arm, noise))
            self._update(self._isam, graph)

    def hidden(self, stretch: Stretch, point: Floats) -> Estimates:
        """The ends of a stretch, on a copy."""
        kept = self._k, self._t_ns, self._state, self._bias
        isam = self._gtsam.ISAM2(self._isam)
        found: Estimates = {}
        for length, end in sorted(stretch.ends.items()):
            while self._t_ns < end.t_ns:
                graph = self._gtsam.NonlinearFactorGraph()
                self._keyframe(graph, min(self._t_ns + round(KEYFRAME_S * NS_PER_S), end.t_ns))
                self._update(isam, graph)
            found[stretch.start_ns, length] = self._estimate(isam, point)
        self._k, self._t_ns, self._state, self._bias = kept
        return found

    def _keyframe(self, graph: Any, t_ns: int) -> None:
        """Add the next keyframe, at t_ns, by the IMU."""
        X, V, B = self._keys
        pim = self._gtsam.PreintegratedImuMeasurements(self._params, self._bias)
        for gyro, accel, dt in zip(*_steps(self._drive, self._t_ns, t_ns), strict=True):
            pim.integrateMeasurement(accel, gyro, dt)
        k = self._k + 1
        graph.add(self._gtsam.ImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), pim))
        gyro_walk, accel_walk = self._drive.bias_walk
        seconds = (t_ns - self._t_ns) / NS_PER_S
        walk = self._gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(seconds * np.repeat([accel_walk, gyro_walk], 3)))
        none = self._gtsam.imuBias.ConstantBias()
        graph.add(self._gtsam.BetweenFactorConstantBias(B(k - 1), B(k), none, walk))
        self._state = pim.predict(self._state, self._bias)
        self._k, self._t_ns = k, t_ns

    def _update(self, isam: Any, graph: Any) -> None:
        X, V, B = self._keys
        isam.update(graph, self._values(self._k))
        estimate = isam.calculateEstimatePose3(X(self._k)), isam.calculateEstimateVector(V(self._k))
        self._state = self._gtsam.NavState(*estimate)
        self._bias = isam.calculateEstimateConstantBias(B(self._k))

    def _values(self, k: int) -> Any:
        X, V, B = self._keys
        values = self._gtsam.Values()
        values.insert(X(k), self._state.pose())
        values.insert(V(k), self._state.velocity())
        values.insert(B(k), self._bias)
        return values

    def _estimate(self, isam: Any, point: Floats) -> Estimate:
        """The point of the body at the last keyframe; gtsam's covariance of a pose is that of its tangent, in body."""
        pose, R = self._state.pose(), self._state.pose().rotation().matrix()
        marginal = isam.marginalCovariance(self._keys[0](self._k))
        place = pose.translation() + R @ point
        x, y, z = point
        J = np.hstack((R @ np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]), R))[:2]
        llh = llh_from_enu(place[None], self._datum)[0]
        to_local = self._plane(llh).T
        cov = to_local[:2, :2] @ (J @ marginal @ J.T) @ to_local[:2, :2].T
        local = to_local @ R
        yaw_var = float(R[2] @ marginal[:3, :3] @ R[2])
        return Estimate(llh, cov, float(np.arctan2(local[1, 0], local[0, 0])), yaw_var)

    def _plane(self, llh: Floats) -> Floats:
        """(3, 3) axes of the plane at the datum from local ENU axes."""
        here: Floats = rotation_ecef_enu(self._datum[None])[0].T @ rotation_ecef_enu(llh[None])[0]
        return here


def _steps(drive: PeerLog, first_ns: int, last_ns: int) -> tuple[Floats, Floats, Floats]:
    """Mean gyro and accel and the length of each step from first to last: the line between samples."""
    imu = drive.imu
    a, b = np.searchsorted(imu.t_ns, first_ns, side="right"), np.searchsorted(imu.t_ns, last_ns)
    t_ns = np.concatenate(([first_ns], imu.t_ns[a:b], [last_ns]))
    t = (t_ns - imu.t_ns[0]) / NS_PER_S
    rows = slice(max(a - 2, 0), b + 2)
    known = (imu.t_ns[rows] - imu.t_ns[0]) / NS_PER_S
    gyro, accel = (
        np.column_stack([np.interp(t, known, c) for c in column[rows].T]) for column in (imu.gyro, imu.accel)
    )
    dt = np.diff(t)
    kept = dt > 0
    return ((gyro[1:] + gyro[:-1]) / 2)[kept], ((accel[1:] + accel[:-1]) / 2)[kept], dt[kept]


def _imu_params(gtsam: Any, drive: PeerLog, datum: Floats) -> Any:
    sine, cosine = np.sin(datum[0]), np.cos(datum[0])
    params = gtsam.PreintegrationParams.MakeSharedU(-gravity_enu(sine, cosine, datum[2])[1])
    params.setOmegaCoriolis(EARTH_RATE * np.array([0.0, cosine, sine]))
    params.setAccelerometerCovariance(np.eye(3) * drive.noise.accel_psd)
    params.setGyroscopeCovariance(np.eye(3) * drive.noise.gyro_psd)
    params.setIntegrationCovariance(np.eye(3) * 1e-9)
    return params
