"""A whole simulated drive: its plan and every sensor, composed into a Log piece by piece."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Latitude, Longitude
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, utm_frame
from sensors.pieces import PIECE_S, join
from sensors.records import Log
from sensors.simulate.course import Course
from sensors.simulate.driver import Driver
from sensors.simulate.environment import Environment
from sensors.simulate.following import TrajectoryPlan
from sensors.simulate.gnss import GnssSensor
from sensors.simulate.gnss_config import GnssSimulation
from sensors.simulate.imu import ImuBiases, ImuSensor, ImuSimulation
from sensors.simulate.lidar_config import LidarSimulation
from sensors.simulate.network import NetworkPlan
from sensors.simulate.noise import Nanoseconds, rows_between, stream
from sensors.simulate.planning import PlannedDrive, plan_drive
from sensors.simulate.pose_fix import PoseFixSensor
from sensors.simulate.pose_fix_config import PoseFixSimulation
from sensors.simulate.reference import ReferenceSimulation, reference
from sensors.simulate.route import CityPlan
from sensors.simulate.scenes import ScenePlan, drive_tags
from sensors.simulate.trajectory import Truth
from sensors.simulate.wheel import WheelSensor, WheelSimulation
from sensors.vehicle import ImuSpec, Vehicle

SHORTEST_S, LONGEST_S = 1.0, 7 * 86_400.0
USUAL_S = 600.0
"""Length of a drive that says neither how long nor how far, s."""


class Start(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where and when the drive begins."""

    latitude_deg: Latitude = 48.137
    """Latitude, deg."""
    longitude_deg: Longitude = 11.575
    """Longitude, deg."""
    height_m: float = 560.0
    """Height above the ellipsoid, m."""
    unix_s: int = 1_715_673_600
    """Time of the first sample, s since 1970 UTC."""


class DriveConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One drive and its sensors."""

    start: Start = Start()
    length_km: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None
    """The drive ends after so much road (or its duration, whichever comes first), km."""
    map_frame: Literal["utm", "enu"] = "utm"
    """Map axes: UTM of the start's zone, or the plane tangent at the start."""
    city: CityPlan = CityPlan()
    network: NetworkPlan | None = None
    """Roads that all seeds share, in place of a city route of each seed's own."""
    network_seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Seed of those roads."""
    trajectory: TrajectoryPlan | None = None
    """Recorded motion to follow instead."""
    environments: dict[str, Environment] = {}
    """What surrounds the road, by scene tag; without any the log has no tags."""
    scenes: ScenePlan = ScenePlan()
    driver: Driver = Driver()
    vehicle: Vehicle = Vehicle(gnss_lever_arm=(0.5, 0.0, 1.2))
    imu: ImuSimulation = ImuSimulation()
    gnss: GnssSimulation = GnssSimulation()
    pose_fix: PoseFixSimulation = PoseFixSimulation()
    wheel: WheelSimulation = WheelSimulation()
    lidar: LidarSimulation = LidarSimulation()
    reference: ReferenceSimulation = ReferenceSimulation()

    def __post_init__(self) -> None:
        if self.imu.preset is not None and self.vehicle.imu != ImuSpec():
            raise EgolocError("imu.preset: expected no [vehicle.imu] beside it, got both")
        if self.network is not None and self.trajectory is not None:
            raise EgolocError("trajectory: expected no [network] beside it, got both")
        for name in ("gnss_delay_s", "gnss_velocity_delay_s"):
            if given := getattr(self.vehicle, name):
                raise EgolocError(f"vehicle.{name}: expected 0 (stamps of simulated GNSS are exact), got {given:g}")


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A log, the exact motion behind it, and the IMU's true biases at the IMU's stamps."""

    log: Log
    truth: Truth
    imu_biases: ImuBiases


def simulate(duration_s: float | None = None, seed: int = 0, config: DriveConfig | None = None) -> Log:
    """The log of a drive; the same duration, seed and config give the same bytes on the same machine."""
    return join(simulate_pieces(duration_s, seed, config))


def simulate_pieces(
    duration_s: float | None = None, seed: int = 0, config: DriveConfig | None = None, piece_s: float = PIECE_S
) -> Iterator[Log]:
    """The log of a drive in pieces of piece_s; however it is cut, the rows are the same."""
    config = config or DriveConfig()
    for log, _ in _sensed(plan(duration_s, seed, config), seed, config, piece_s):
        yield log


def simulate_drive(duration_s: float | None = None, seed: int = 0, config: DriveConfig | None = None) -> Drive:
    """The log of a drive together with its truth, for tests."""
    config = config or DriveConfig()
    return simulated(plan(duration_s, seed, config), seed, config)


def sense(truth: Truth, duration_s: float, seed: int, config: DriveConfig) -> Drive:
    """What the sensors of config measure along any motion, from its zero seconds on."""
    return simulated(PlannedDrive(truth, featureless(truth), duration_s), seed, config)


def city_truth(duration_s: float, seed: int, config: DriveConfig) -> Truth:
    """The exact motion of a drive through a random city."""
    return plan(duration_s, seed, config).truth


def plan(duration_s: float | None, seed: int, config: DriveConfig) -> PlannedDrive:
    """Motion and course of the drive of a seed: as long as duration_s, as far as config's length, what ends first."""
    if duration_s is not None and not SHORTEST_S <= duration_s <= LONGEST_S:
        raise EgolocError(
            f"simulate: duration: expected at least {SHORTEST_S:g} s, at most a week, got {duration_s:g} s"
        )
    if seed < 0:
        raise EgolocError(f"simulate: seed: expected 0 or more, got {seed}")
    start = config.start
    if duration_s is None and config.length_km is None and config.trajectory is None:
        duration_s = USUAL_S
    return plan_drive(
        config.trajectory or config.network or config.city,
        config.environments,
        config.driver,
        (np.radians(start.latitude_deg), np.radians(start.longitude_deg), start.height_m),
        start.unix_s * NS_PER_S,
        seed,
        network_seed=config.network_seed,
        duration_s=duration_s,
        length_km=config.length_km,
    )


def featureless(truth: Truth) -> Course:
    """A course along any motion with nothing around it."""
    first, last = truth.span_ns
    t_ns = np.arange(first, last + 1, NS_PER_S // 10)
    speed = truth.forward_speed(t_ns)
    s = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    s = np.maximum.accumulate(s)
    edges, kind, zero = np.array([s[0], max(s[-1], 1.0)]), np.zeros(1, np.intp), np.zeros((1, 3))
    return Course(t_ns, s, ("",), (Environment(),), edges, kind, s[:1], zero)


def simulated(planned: PlannedDrive, seed: int, config: DriveConfig) -> Drive:
    """What the sensors measure on a planned drive."""
    parts = list(_sensed(planned, seed, config, PIECE_S))
    gyro, accel = (np.concatenate([getattr(biases, name) for _, biases in parts]) for name in ("gyro", "accel"))
    return Drive(join(log for log, _ in parts), planned.truth, ImuBiases(gyro, accel))


def _sensed(planned: PlannedDrive, seed: int, config: DriveConfig, piece_s: float) -> Iterator[tuple[Log, ImuBiases]]:
    """Pieces of the log with the IMU's biases in them."""
    sensors = _Sensors(planned, seed, config)
    for index in range(int(planned.duration_s / piece_s) + 1):
        yield sensors.between(index * piece_s, (index + 1) * piece_s)


class _Sensors:
    """The sensors of one drive."""

    def __init__(self, planned: PlannedDrive, seed: int, config: DriveConfig) -> None:
        truth, course, duration_s = planned
        self._truth, self._duration_s, self._config = truth, duration_s, config
        spec, _ = config.imu.part(config.vehicle.imu)
        vehicle = msgspec.structs.replace(config.vehicle, imu=spec)
        self._frame = map_frame(truth, config.map_frame)
        scene, mode, night = drive_tags(course, truth.start_ns, duration_s, config.scenes, seed)
        self._tags = {"scene": scene, "mode": mode} if config.environments else {}
        self._imu = ImuSensor(truth, course, duration_s, spec, config.imu, stream(seed, "imu"))
        self._gnss = GnssSensor(course, vehicle, config.gnss, stream(seed, "gnss"))
        self._pose_fix = PoseFixSensor(
            course, self._frame, vehicle, config.pose_fix, stream(seed, "pose_fix"), night=night
        )
        self._wheel = WheelSensor(truth, course, vehicle, config.wheel, stream(seed, "wheel"))
        self._vehicle = vehicle

    def between(self, begin_s: float, end_s: float) -> tuple[Log, ImuBiases]:
        """What they measure in [begin_s, end_s), the next piece."""
        config, truth = self._config, self._truth

        def times(rate_hz: float, phase_s: float = 0.0) -> Nanoseconds:
            return rows_between(truth.start_ns, self._duration_s, rate_hz, phase_s, begin_s, end_s)

        imu, biases = self._imu.sense(times(config.imu.rate_hz))
        records: dict[str, Any] = {"imu": imu}
        if config.gnss.use:
            records["gnss"], records["gnss_velocity"] = self._gnss.sense(truth.at(times(config.gnss.rate_hz)))
        if config.pose_fix.use:
            motion = truth.at(times(config.pose_fix.rate_hz, config.pose_fix.phase_s))
            records["pose_fixes"] = self._pose_fix.sense(motion)
        if config.wheel.use:
            records["wheel"] = self._wheel.sense(times(config.wheel.rate_hz))
        if config.reference.use:
            t_ns = times(config.reference.rate_hz)
            t_ns = t_ns[t_ns >= truth.start_ns + round(config.reference.start_s * NS_PER_S)]
            records["reference"] = reference(truth.at(t_ns), self._frame, self._vehicle, config.reference)
        for name, tags in self._tags.items():
            first, last = np.searchsorted(tags.t_ns, _window(truth.start_ns, begin_s, end_s))
            records[name] = tags[first:last]
        kept = {name: record for name, record in records.items() if len(record)}
        return Log(**kept, vehicle=self._vehicle, map_frame=self._frame), biases


def _window(start_ns: int, begin_s: float, end_s: float) -> NDArray[np.int64]:
    window: NDArray[np.int64] = start_ns + np.rint(np.array([begin_s, end_s]) * NS_PER_S).astype(np.int64)
    return window


def map_frame(truth: Truth, kind: Literal["utm", "enu"]) -> MapFrame:
    """Map axes of a drive: those of its first place."""
    llh = truth.at(np.array([truth.start_ns])).llh[0]
    if kind == "enu":
        return MapFrame("enu", (float(np.degrees(llh[0])), float(np.degrees(llh[1])), float(llh[2])))
    return utm_frame(llh)
