"""pyins over hidden stretches: its feedback filter over arrays, one pass over the drive, a copy at every start.

The loop is that of ``pyins.filters.run_feedback_filter`` (which cannot be stopped and copied, and spends a tenth of a
second per fix in pandas), made of pyins' own parts: increments, strapdown, error model, van Loan's integral, Jacobians,
correction. A test holds it to the original.
"""

from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.timeline import grid, periods
from replay.bench.hidden_egoloc import Estimate, Estimates
from replay.bench.hidden_peers import PeerLog
from replay.bench.hidden_plan import Plan, Stretch
from sensors.clock import NS_PER_S
from sensors.rotation import matrix_from_q

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

FRD = np.array([1.0, -1.0, -1.0])
"""Body axes of pyins are forward-right-down."""
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""From ENU."""
NON_HOLONOMIC, PER_SPEED = (0.1, 0.2), 0.01
"""Lateral and vertical velocity of the rear axle and their growth with speed, m/s and m/s per m/s: usual figures, and
among the best on the first half of rtk_drive, on which they were chosen for egoloc before it learned its own."""
STEP_S = 1.0
"""Longest step of the covariance, as pyins recommends."""
INS, GYRO, ACCEL = slice(0, 9), slice(9, 12), slice(12, 15)
POSITION, VELOCITY, WHEEL, LAND = range(4)


class State(NamedTuple):
    """After IMU sample k: lla (3,) deg, deg, m; velocity NED m/s; mat_nb (3, 3); P (15, 15) in pyins' internal errors;
    biases of gyro rad/s and accelerometer m/s^2."""

    k: int
    lla: Floats
    velocity: Floats
    mat_nb: Floats
    P: Floats
    gyro_bias: Floats
    accel_bias: Floats


class Event(NamedTuple):
    """A measurement: when, what kind, and its row."""

    t_ns: int
    kind: int
    row: int


class Pva:
    """What pyins' error model asks of a position-velocity-attitude, without pandas; rows: as a table of one."""

    def __init__(self, lla: Floats, velocity: Floats, rph: Floats, rows: bool = False) -> None:
        self._columns = {"lat": lla, "VN": velocity, "roll": rph}
        self._rows = rows
        self.lat: Any = lla[[0]] if rows else lla[0]
        self.alt: Any = lla[[2]] if rows else lla[2]
        self.shape = (1, 9)

    def __len__(self) -> int:
        return 1

    def __getitem__(self, columns: list[str]) -> Any:
        found = self._columns[columns[0]]
        return found[None] if self._rows else found


def ends(drive: PeerLog, plan: Plan, kinds: Sequence[int]) -> Estimates:
    """The end of each of the plan's stretches; kinds: of POSITION, VELOCITY, WHEEL, LAND, what is used.

    LAND: zero velocity at rest, else no lateral and vertical velocity, as often as egoloc does.
    """
    own = Filter(drive)
    last_ns = max(stretch.last_ns for stretch in plan.stretches)
    events = _events(drive, kinds, last_ns)
    found: Estimates = {}
    for begin, until in pairwise([*drive.begin_ns.tolist(), last_ns + 1]):
        state, now = own.start(begin), begin
        for stretch in plan.stretches:
            if begin <= stretch.start_ns < until:
                state = own.run(state, _between(events, now, stretch.start_ns))
                now = stretch.start_ns
                found |= own.hidden(state, stretch, events, plan.point)
    return found


def _events(drive: PeerLog, kinds: Sequence[int], last_ns: int) -> list[Event]:
    """All measurements of these kinds up to a time, in order."""
    ticks = grid(int(drive.begin_ns[0]), last_ns, periods(drive.config, True)[1])
    times = {POSITION: drive.positions.t_ns, VELOCITY: drive.velocities.t_ns, WHEEL: drive.wheel.t_ns, LAND: ticks}
    return sorted(Event(int(t), kind, row) for kind in kinds for row, t in enumerate(times[kind]) if t <= last_ns)


def _between(events: list[Event], first_ns: int, end_ns: int) -> list[Event]:
    """Those in [first, end)."""
    return events[bisect_left(events, (first_ns,)) : bisect_left(events, (end_ns,))]


class Filter:
    """The parts of pyins and the drive's arrays; states go in and come out."""

    def __init__(self, drive: PeerLog) -> None:
        from pandas import DataFrame
        from pyins import strapdown, util
        from pyins.error_model import InsErrorModel

        self._drive, self._model = drive, InsErrorModel()
        self._t_ns = drive.imu.t_ns
        t = (self._t_ns - self._t_ns[0]) / NS_PER_S
        samples = np.hstack((drive.imu.gyro * FRD, drive.imu.accel * FRD))
        table = strapdown.compute_increments_from_imu(
            DataFrame(samples, index=t, columns=[*util.GYRO_COLS, *util.ACCEL_COLS]), "rate"
        ).to_numpy()
        self._dt, self._theta, self._dv = table[:, 0].copy(), table[:, 1:4].copy(), table[:, 4:7].copy()
        self._rest = frozenset(drive.rest_ns.tolist())
        gyro_walk, accel_walk = drive.bias_walk
        self._walk = np.repeat([gyro_walk, accel_walk], 3)

    def start(self, t_ns: int) -> State:
        """egoloc's state at t_ns with the sigmas of that."""
        from pyins import transform

        llh, velocity, q, gyro_bias, accel_bias, sigma = self._drive.first_state(t_ns)
        k = int(np.searchsorted(self._t_ns, t_ns, side="right")) - 1
        lla, mat_nb = _degrees(llh), NED @ matrix_from_q(q) * FRD
        rph = transform.mat_to_rph(mat_nb)
        internal = self._model.transform_to_internal(Pva(lla, NED @ velocity, rph, rows=True))[0]
        P = np.zeros((15, 15))
        sd = np.concatenate((sigma[[1, 0, 2]], sigma[[4, 3, 5]], np.degrees(sigma[6:9])))
        P[INS, INS] = internal @ np.diag(sd**2) @ internal.T
        P[GYRO, GYRO], P[ACCEL, ACCEL] = np.diag(sigma[9:12] ** 2), np.diag(sigma[12:15] ** 2)
        return State(k, lla, NED @ velocity, mat_nb, P, gyro_bias * FRD, accel_bias * FRD)

    def run(self, state: State, events: Sequence[Event]) -> State:
        """Go through measurements in order; those at one time are applied together, to the sample at or before it."""
        i = 0
        while i < len(events):
            t_ns = events[i].t_ns
            state = self.advance(state, t_ns)
            x, P = np.zeros(15), state.P
            lla, velocity, mat_nb, rate = self._predicted(state, t_ns)
            while i < len(events) and events[i].t_ns == t_ns:
                x, P = self._correct(x, P, events[i], lla, velocity, mat_nb, rate)
                i += 1
            state = _corrected(state, x, P)
        return state

    def hidden(self, state: State, stretch: Stretch, events: list[Event], point: Floats) -> Estimates:
        """The ends of a stretch, without GNSS."""
        found: Estimates = {}
        now = stretch.start_ns
        for length, end in sorted(stretch.ends.items()):
            state = self.run(state, [e for e in _between(events, now, end.t_ns) if e.kind in (WHEEL, LAND)])
            now = end.t_ns
            found[stretch.start_ns, length] = self.estimate(state, now, point)
        return found

    def advance(self, state: State, t_ns: int) -> State:
        """Go on to the last sample at or before t_ns."""
        last = int(np.searchsorted(self._t_ns, t_ns, side="right")) - 1
        while state.k < last:
            reach = int(np.searchsorted(self._t_ns, self._t_ns[state.k] + STEP_S * NS_PER_S, side="right")) - 1
            state = self._step(state, min(max(reach, state.k + 1), last))
        return state

    def estimate(self, state: State, t_ns: int, point: Floats) -> Estimate:
        """The point of the body at t_ns."""
        from pyins import transform

        state = self.advance(state, t_ns)
        lla, _, mat_nb, _ = self._predicted(state, t_ns)
        place = transform.perturb_lla(lla, mat_nb @ (point * FRD))
        rph = transform.mat_to_rph(mat_nb)
        H = self._model.position_error_jacobian(Pva(lla, state.velocity, rph), point * FRD)[:2]
        cov = H @ state.P[INS, INS] @ H.T
        T = self._model.transform_to_output(Pva(lla, state.velocity, rph, rows=True))[0, 8]
        llh = np.array([*np.radians(place[:2]), place[2]])
        yaw_var = float(T @ state.P[INS, INS] @ T) * np.radians(1.0) ** 2
        return Estimate(llh, cov[::-1, ::-1], float(np.radians(90.0 - rph[2])), yaw_var)

    def _step(self, state: State, last: int) -> State:
        """Strapdown over the increments up to sample last, and the covariance over all of them at once."""
        from pyins._numba_integrate import integrate
        from scipy.spatial.transform import Rotation

        dt = self._dt[state.k : last]
        theta = self._theta[state.k : last] - state.gyro_bias * dt[:, None]
        dv = self._dv[state.k : last] - state.accel_bias * dt[:, None]
        lla, velocity, mat_nb = np.empty((len(dt) + 1, 3)), np.empty((len(dt) + 1, 3)), np.empty((len(dt) + 1, 3, 3))
        lla[0], velocity[0], mat_nb[0] = state.lla, state.velocity, state.mat_nb
        integrate(dt, lla, velocity, mat_nb, theta, dv, 0, True)
        middle = Rotation.from_matrix(mat_nb[[0, -1]]).mean().as_euler("xyz", degrees=True)
        average = Pva(0.5 * (lla[0] + lla[-1]), 0.5 * (velocity[0] + velocity[-1]), middle, rows=True)
        P = self._propagated(state.P, average, float(dt.sum()))
        return State(last, lla[-1], velocity[-1], mat_nb[-1], P, state.gyro_bias, state.accel_bias)

    def _propagated(self, P: Floats, average: Pva, seconds: float) -> Floats:
        from pyins import kalman

        noise = self._drive.noise
        (F_ins,), (by_gyro,), (by_accel,) = self._model.system_matrices(average)
        F, Q = np.zeros((15, 15)), np.zeros((15, 15))
        F[INS, INS], F[INS, GYRO], F[INS, ACCEL] = F_ins, by_gyro, by_accel
        Q[INS, INS] = by_gyro @ by_gyro.T * noise.gyro_psd + by_accel @ by_accel.T * noise.accel_psd
        Q[9:, 9:] = np.diag(self._walk)
        Phi, Qd = kalman.compute_process_matrices(F, Q, seconds)
        result: Floats = Phi @ P @ Phi.T + Qd
        return result

    def _predicted(self, state: State, t_ns: int) -> tuple[Floats, Floats, Floats, Floats]:
        """lla, velocity, mat_nb at t_ns within the next interval, and the rate there."""
        from pyins._numba_integrate import integrate

        k = min(state.k, len(self._dt) - 1)
        dt = self._dt[[k]]
        theta, dv = self._theta[[k]] - state.gyro_bias * dt, self._dv[[k]] - state.accel_bias * dt
        part = float(t_ns - self._t_ns[state.k]) / NS_PER_S / dt[0]
        lla, velocity, mat_nb = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3, 3))
        lla[0], velocity[0], mat_nb[0] = state.lla, state.velocity, state.mat_nb
        integrate(part * dt, lla, velocity, mat_nb, part * theta, part * dv, 0, True)
        return lla[1], velocity[1], mat_nb[1], theta[0] / dt[0]

    def _correct(
        self, x: Floats, P: Floats, event: Event, lla: Floats, velocity: Floats, mat_nb: Floats, rate: Floats
    ) -> tuple[Floats, Floats]:
        from pyins import kalman, transform

        pva = Pva(lla, velocity, transform.mat_to_rph(mat_nb))
        drive, row = self._drive, event.row
        arm = drive.arm * FRD
        if event.kind == POSITION:
            z = transform.compute_lla_difference(lla, _degrees(drive.positions.value[row])) + mat_nb @ arm
            found = z, self._model.position_error_jacobian(pva, arm), NED @ drive.positions.cov[row] @ NED.T
        elif event.kind == VELOCITY:
            z = velocity + mat_nb @ np.cross(rate, arm) - NED @ drive.velocities.value[row]
            found = z, _velocity_jacobian(velocity), NED @ drive.velocities.cov[row] @ NED.T
        else:
            aid = self._aid(event, pva, velocity, mat_nb, rate)
            if aid is None:
                return x, P
            found = aid
        z, H, R = found
        x, P, _ = kalman.correct(x, P, z, np.hstack((H, np.zeros((len(z), 6)))), R)
        return x, P

    def _aid(
        self, event: Event, pva: Pva, velocity: Floats, mat_nb: Floats, rate: Floats
    ) -> tuple[Floats, Floats, Floats] | None:
        """Wheel speed, zero velocity or the non-holonomic constraint."""
        motion, wheel = self._drive.config.motion, self._drive.wheel
        in_body = mat_nb.T @ velocity + np.cross(rate, self._drive.axle * FRD)
        H = self._model.body_velocity_error_jacobian(pva)
        if event.kind == WHEEL:
            return in_body[:1] - wheel.value[event.row], H[:1], wheel.cov[event.row]
        if event.t_ns in self._rest:
            return velocity, _velocity_jacobian(velocity), np.eye(3) * motion.zero_velocity_sigma**2
        speed = float(np.linalg.norm(velocity))
        if speed < motion.min_speed:
            return None
        return in_body[1:], H[1:], np.diag(np.square(NON_HOLONOMIC) + (PER_SPEED * speed) ** 2)


def _corrected(state: State, x: Floats, P: Floats) -> State:
    """InsErrorModel.correct_pva, and the biases."""
    from pyins import transform
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(x[6:9]).as_matrix()
    return State(
        state.k,
        transform.perturb_lla(state.lla, -x[0:3]),
        turn @ (state.velocity - x[3:6]),
        turn @ state.mat_nb,
        P,
        state.gyro_bias + x[GYRO],
        state.accel_bias + x[ACCEL],
    )


def _velocity_jacobian(velocity: Floats) -> Floats:
    """InsErrorModel.ned_velocity_error_jacobian, which takes a pandas Series only: (3, 9)."""
    from pyins import util

    return np.hstack((np.zeros((3, 3)), np.eye(3), util.skew_matrix(velocity)))


def _degrees(llh: Floats) -> Floats:
    return np.array([*np.degrees(llh[:2]), llh[2]])
