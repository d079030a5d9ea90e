"""Where the search for a frame's pose begins: at a trajectory of the log, off it on purpose, or where a filter is."""

from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from egovm.dataset import NOISES, InitialNoise, planar
from fusion.config import FusionConfig
from fusion.filter import Localizer, State
from replay.config import RunConfig
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.mcap.io import read_pieces
from sensors.mcap.topics import FRAMES
from sensors.motion import ConstantVelocity, Motion, along, relative, span_of
from sensors.pieces import SENSORS, joined
from sensors.records import Imu, Log, PoseFix, Trajectory
from sensors.rotation import matrix_from_q
from sensors.vehicle import Vector3, Vehicle

Floats = NDArray[np.float64]

NEVER_NS = -(2**62)
_TAIL_NS = 3 * NS_PER_S
"""Of a trajectory, kept for frames that begin before the next piece."""
_FRAME_NS = NS_PER_S // 2
"""Points and images of a frame are at most so much later than its stamp, as long as the log goes on."""
_CARRIED_NS = NS_PER_S // 5
"""A filter's state is carried so far from its last IMU sample."""


class Start(NamedTuple):
    """T_map_body: (4, 4) initial pose at the frame's time; motion: of the vehicle around it."""

    T_map_body: Floats
    motion: Motion


class InitialPoses(Protocol):
    """Pieces of the log go in as they come, and what was found of each frame."""

    def add(self, piece: Log) -> None:
        """The next piece."""

    def known_ns(self) -> int:
        """Frames up to this time can be asked for by now."""

    def at(self, frame: Frame) -> Start | str:
        """The start of a frame, later than those before; or why there is none."""

    def take(self, fix: PoseFix) -> None:
        """What was found there."""

    def lacks(self) -> str | None:
        """What the log would have to hold for any start."""


class KnownPoses:
    """Along a trajectory, each frame off it by noise of its own."""

    def __init__(self, noise: InitialNoise | None, seed: int, arm: Vector3, whole: Trajectory | None = None) -> None:
        """noise: None: the trajectory as it is; arm: the point of the body whose trajectory it is, m; whole: all of it,
        None: the reference of the pieces."""
        self._noise, self._seed, self._arm = noise, seed, arm
        self._rows = self._whole = whole
        self._motion = None if whole is None else along(whole, arm)
        self._last_ns = NEVER_NS
        self._why_not = "no poses yet"

    def add(self, piece: Log) -> None:
        """The next piece."""
        if self._whole is not None:
            records = (getattr(piece, name) for name in SENSORS)
            self._last_ns = max([self._last_ns, *(int(each.t_ns[-1]) for each in records if each is not None)])
        elif piece.reference is not None and len(piece.reference):
            self._go_on(piece.reference)

    def _go_on(self, rows: Trajectory) -> None:
        if self._rows is not None:
            rows = joined([self._rows[self._rows.t_ns >= rows.t_ns[0] - _TAIL_NS], rows])
        self._rows, self._last_ns = rows, int(rows.t_ns[-1])
        try:
            self._motion = along(rows, self._arm)
        except EgolocError as error:  # more rows with an attitude may come
            self._motion, self._why_not = None, str(error)

    def known_ns(self) -> int:
        """Where a frame's points and images end is known as well."""
        return self._last_ns - _FRAME_NS

    def at(self, frame: Frame) -> Start | str:
        """The trajectory's pose, off by noise."""
        if self._motion is None:
            return self._why_not
        if not self._motion.covers(*span_of(frame)):
            return "outside the trajectory"
        T = self._motion.poses.pose(frame.t_ns)
        if self._noise is not None:
            rng = np.random.default_rng([self._seed, frame.t_ns])
            T = T @ np.linalg.inv(planar(self._noise.draw(rng)))
        return Start(T, self._motion)

    def take(self, fix: PoseFix) -> None:
        """Known poses learn nothing."""

    def lacks(self) -> str | None:
        """A trajectory."""
        return "a reference for --init reference, got none" if self._rows is None else None


class PredictedPoses:
    """Where a filter is that has the log's IMU, GNSS and wheel, and the fixes of the frames before."""

    def __init__(self, vehicle: Vehicle, map_frame: MapFrame, config: FusionConfig) -> None:
        self._localizer = Localizer(vehicle, map_frame, config)
        self._frame = map_frame
        self._imu: Imu | None = None
        self._gyro: Floats = np.zeros(3)

    def add(self, piece: Log) -> None:
        """Measurements wait in the filter until the IMU comes by."""
        for name in ("gnss", "gnss_velocity", "wheel"):
            record = getattr(piece, name)
            if record is not None and len(record):
                self._localizer.push(record)
        if piece.imu is not None and len(piece.imu):
            self._imu = piece.imu if self._imu is None else joined([self._imu, piece.imu])

    def known_ns(self) -> int:
        """The IMU is known up to there."""
        return NEVER_NS if self._imu is None or not len(self._imu) else int(self._imu.t_ns[-1])

    def at(self, frame: Frame) -> Start | str:
        """The filter's state, carried on from the last IMU sample to the frame as that sample says."""
        imu = self._imu
        if imu is None:
            return "no IMU samples"
        passed = int(np.searchsorted(imu.t_ns, frame.t_ns, side="right"))
        if passed:
            self._imu, self._gyro = imu[passed:], imu.gyro[passed - 1]
            self._localizer.push(imu[:passed])
            self._localizer.take_states()
            self._localizer.take_decisions()
        state = self._localizer.state()
        if state is None:
            return "the filter was not aligned"
        if frame.t_ns - state.t_ns > _CARRIED_NS:
            return "in a gap of the IMU"
        return _carried(state, self._gyro - state.gyro_bias, self._frame, frame.t_ns)

    def take(self, fix: PoseFix) -> None:
        """The filter goes on with it."""
        self._localizer.push(fix)

    def lacks(self) -> str | None:
        """The IMU."""
        return "IMU samples for --init filter, got none" if self._imu is None else None


def _carried(state: State, turn_rate: Floats, map_frame: MapFrame, t_ns: int) -> Start:
    """A state at another time, as it moves and turns (3,) rad/s now."""
    llh = state.llh[None]
    R_enu_body = matrix_from_q(state.q_enu_body)
    T = np.eye(4)
    T[:3, :3] = rotation_map_enu(map_frame, llh)[0][0] @ R_enu_body
    T[:3, 3] = map_from_llh(map_frame, llh)[0]
    vx, vy, vz = (state.vel_enu @ R_enu_body).tolist()
    wx, wy, wz = turn_rate.tolist()
    motion = ConstantVelocity((vx, vy, vz), (wx, wy, wz))
    return Start(T @ relative(motion, t_ns, state.t_ns), motion)


def check_init(init: str) -> None:
    """Raise EgolocError unless it is filter, reference, reference+NOISE or a topic."""
    kind, _, noise = init.partition("+")
    known = init == "filter" or init.startswith("/") or (kind == "reference" and (not noise or noise in NOISES))
    if not known or init.endswith("+"):
        noises = ", ".join(f"reference+{name}" for name in NOISES)
        raise EgolocError(f"--init: expected filter, reference, {noises} or a /topic with poses, got {init!r}")


def initial_poses(
    log: Path, init: str, seed: int, vehicle: Vehicle, map_frame: MapFrame, config: RunConfig
) -> KnownPoses | PredictedPoses:
    """What ``check_init`` let pass. seed: of noise. The poses of a topic are read at once."""
    if init == "filter":
        return PredictedPoses(vehicle, map_frame, config.fusion)
    if init.startswith("/"):
        return KnownPoses(None, seed, vehicle.reference_lever_arm, _poses_of(log, init, config))
    noise = init.partition("+")[2]
    return KnownPoses(NOISES[noise] if noise else None, seed, vehicle.reference_lever_arm)


def _poses_of(log: Path, topic: str, config: RunConfig) -> Trajectory:
    """A log's poses of a topic."""
    columns = {sensor: given for sensor, given in config.topics.items() if sensor not in FRAMES}
    rows = [
        piece.reference for piece in read_pieces(log, columns | {"reference": topic}) if piece.reference is not None
    ]
    if not rows:
        raise EgolocError(f"{log}: {topic}: expected poses for --init, got none")
    whole: Trajectory = joined(rows)
    return whole
