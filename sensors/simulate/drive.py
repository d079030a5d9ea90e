"""A whole simulated drive: route, driver, truth and every sensor, composed into a Log."""

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Latitude, Longitude
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, utm_frame
from sensors.records import Log
from sensors.simulate.driver import Driver, drive_profile
from sensors.simulate.gnss import GnssSimulation, simulate_gnss
from sensors.simulate.imu import ImuBiases, ImuSimulation, simulate_imu
from sensors.simulate.noise import stamps, stream
from sensors.simulate.pose_fix import PoseFixSimulation, simulate_pose_fixes
from sensors.simulate.reference import ReferenceSimulation, reference
from sensors.simulate.route import CityPlan, city_route
from sensors.simulate.trajectory import MARGIN_S, Truth
from sensors.simulate.wheel import WheelSimulation, simulate_wheel
from sensors.vehicle import Vehicle

SHORTEST_S, LONGEST_S = 1.0, 7 * 86_400.0


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
    map_frame: Literal["utm", "enu"] = "utm"
    """Map axes: UTM of the start's zone, or the plane tangent at the start."""
    city: CityPlan = CityPlan()
    driver: Driver = Driver()
    vehicle: Vehicle = Vehicle(gnss_lever_arm=(0.5, 0.0, 1.2))
    imu: ImuSimulation = ImuSimulation()
    gnss: GnssSimulation = GnssSimulation()
    pose_fix: PoseFixSimulation = PoseFixSimulation()
    wheel: WheelSimulation = WheelSimulation()
    reference: ReferenceSimulation = ReferenceSimulation()


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A log, the exact motion behind it, and the IMU's true biases at the IMU's stamps."""

    log: Log
    truth: Truth
    imu_biases: ImuBiases


def simulate(duration_s: float = 600.0, seed: int = 0, config: DriveConfig | None = None) -> Log:
    """The log of a drive; the same duration, seed and config give the same bytes on the same machine."""
    return simulate_drive(duration_s, seed, config).log


def simulate_drive(duration_s: float = 600.0, seed: int = 0, config: DriveConfig | None = None) -> Drive:
    """The log of a drive together with its truth, for tests."""
    config = config or DriveConfig()
    return sense(city_truth(duration_s, seed, config), duration_s, seed, config)


def city_truth(duration_s: float, seed: int, config: DriveConfig) -> Truth:
    """The exact motion of a drive through a random city."""
    if not SHORTEST_S <= duration_s <= LONGEST_S:
        raise EgolocError(
            f"simulate: duration: expected at least {SHORTEST_S:g} s, at most a week, got {duration_s:g} s"
        )
    if seed < 0:
        raise EgolocError(f"simulate: seed: expected 0 or more, got {seed}")
    rng = stream(seed, "route")
    yaw = rng.uniform(-np.pi, np.pi)
    length_m = max(config.city.speed_limits) * (duration_s + 2 * MARGIN_S)
    route = city_route(config.city, length_m, rng)
    start = config.start
    llh = (np.radians(start.latitude_deg), np.radians(start.longitude_deg), start.height_m)
    return Truth(drive_profile(route, config.driver, duration_s, yaw), llh, start.unix_s * NS_PER_S)


def sense(truth: Truth, duration_s: float, seed: int, config: DriveConfig) -> Drive:
    """What the sensors of config measure along any motion, from its zero seconds on."""

    def times(rate_hz: float, phase_s: float = 0.0) -> NDArray[np.int64]:
        return stamps(truth.start_ns, duration_s, rate_hz, phase_s)

    vehicle, frame = config.vehicle, _map_frame(truth, config.map_frame)
    rng = stream(seed, "imu") if config.imu.errors else None
    imu, biases = simulate_imu(truth, times(config.imu.rate_hz), vehicle.imu, rng, config.imu.delay_s)
    fixes = velocities = pose_fixes = wheel = trajectory = None
    if config.gnss.use:
        motion = truth.at(times(config.gnss.rate_hz))
        fixes, velocities = simulate_gnss(motion, vehicle, config.gnss, stream(seed, "gnss"))
    if config.pose_fix.use:
        motion = truth.at(times(config.pose_fix.rate_hz, config.pose_fix.phase_s))
        pose_fixes = simulate_pose_fixes(motion, frame, vehicle, config.pose_fix, stream(seed, "pose_fix"))
    if config.wheel.use:
        wheel = simulate_wheel(truth, times(config.wheel.rate_hz), vehicle, config.wheel, stream(seed, "wheel"))
    if config.reference.use:
        trajectory = reference(truth, times(config.reference.rate_hz), frame, vehicle, config.reference)
    log = Log(imu, fixes, velocities, pose_fixes, wheel, trajectory, vehicle=vehicle, map_frame=frame)
    return Drive(log, truth, biases)


def _map_frame(truth: Truth, kind: Literal["utm", "enu"]) -> MapFrame:
    llh = truth.at(np.array([truth.start_ns])).llh[0]
    if kind == "enu":
        return MapFrame("enu", (float(np.degrees(llh[0])), float(np.degrees(llh[1])), float(llh[2])))
    return utm_frame(llh)
