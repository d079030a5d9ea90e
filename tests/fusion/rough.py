"""Drives whose sensors fail as they do on the road, and how far off the fused states are."""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from fusion.result import FusionResult
from sensors.geodesy import enu_from_llh, map_from_llh
from sensors.records import GnssFix, GnssStatus, Log, PoseFix
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate.drive import Drive, DriveConfig, simulate_drive
from sensors.simulate.gnss import displaced
from sensors.simulate.reference import attitude_in_map
from tests.fusion.free import Floats
from tests.fusion.scenes import seconds, without

LIMITS = np.array([0.6, 0.3, 1.0])
"""Longitudinal and lateral m, yaw deg."""


@dataclass(frozen=True)
class Rough:
    """How often things go wrong, per hour, and what the pose fixes' errors are like."""

    outages: float = 12.0
    """Tunnels and canyons without GNSS, 10 to 90 s."""
    wrong_fixes: float = 6.0
    """Half a metre to four metres off with a sigma of 1.5 cm, 10 to 60 s; every third outage ends in one as well."""
    multipath: float = 10.0
    """Float solutions metres off with a sigma of 0.2 m, 3 to 15 s."""
    blind: float = 30.0
    """Nothing to see along the road, 4 to 10 s."""
    dashes: float = 6.0
    """Aliases by one or two lane dashes, 1 to 5 s."""
    lanes: float = 2.0
    """Aliases by a lane, 1 to 10 s."""
    gross: float = 36.0
    """Bursts of two frames on average: metres and up to ten degrees off with the usual covariance."""
    sigmas: tuple[float, float, float] = (0.045, 0.033, 0.16)
    """Of the pose fixes: longitudinal and lateral m, yaw deg."""
    correlated: tuple[float, float, float] = (0.5, 0.7, 0.7)
    """Share of their variance that is correlated over correlation_m of road."""
    correlation_m: float = 300.0


def rough_drive(duration_s: float, seed: int, rough: Rough = Rough()) -> tuple[Drive, Floats]:
    """A city drive, and the errors of its pose fixes (N, 3): along m, left m, yaw rad."""
    white = msgspec.structs.replace(DriveConfig().pose_fix, correlated_fraction=0.0)
    drive = simulate_drive(duration_s, seed, msgspec.structs.replace(DriveConfig(), pose_fix=white))
    rng = np.random.default_rng([seed, 77])
    log = _with_gnss_faults(drive.log, duration_s, rough, rng)
    fixes, errors = _with_pose_faults(drive, duration_s, rough, rng)
    return replace(drive, log=replace(log, pose_fixes=fixes)), errors


def windows(rng: np.random.Generator, duration_s: float, per_hour: float, length_s: tuple[float, float]) -> Floats:
    """(N, 2) begin and end of events, s."""
    begin = 5.0 + rng.random(rng.poisson(per_hour * duration_s / 3600)) * (duration_s - 5.0)
    return np.column_stack((begin, begin + rng.uniform(*length_s, len(begin))))


def off(fixes: GnssFix, inside: Floats, offset_enu: Floats, status: GnssStatus, sigma: float) -> GnssFix:
    """Fixes displaced where inside (N,) is true, with the status and the sigma that the receiver then claims."""
    claimed = np.diag([sigma, sigma, 1.8 * sigma]) ** 2
    return replace(
        fixes,
        llh=np.where(inside[:, None], displaced(fixes.llh, np.tile(offset_enu, (len(fixes), 1))), fixes.llh),
        cov_enu=np.where(inside[:, None, None], claimed, fixes.cov_enu),
        status=np.where(inside, status, fixes.status).astype(np.int8),
    )


def _with_gnss_faults(log: Log, duration_s: float, rough: Rough, rng: np.random.Generator) -> Log:
    outages = windows(rng, duration_s, rough.outages, (10.0, 90.0))
    wrong = list(windows(rng, duration_s, rough.wrong_fixes, (10.0, 60.0)))
    wrong += [(end, end + rng.uniform(10.0, 60.0)) for _, end in outages if rng.random() < 0.33]
    fixes = log.gnss
    assert fixes is not None
    s = seconds(log, fixes.t_ns)
    for begin, end in wrong:
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 4.0)
        offset = np.array([far * np.cos(angle), far * np.sin(angle), rng.normal(0.0, 2.0)])
        fixes = off(fixes, (s >= begin) & (s < end), offset, GnssStatus.FIXED, 0.015)
    for begin, end in windows(rng, duration_s, rough.multipath, (3.0, 15.0)):
        fixes = off(fixes, (s >= begin) & (s < end), rng.normal(0.0, 1.5, 3), GnssStatus.FLOAT, 0.2)
    velocity = log.gnss_velocity
    for begin, end in outages:
        fixes, velocity = without(fixes, log, begin, end), without(velocity, log, begin, end)
    return replace(log, gnss=fixes, gnss_velocity=velocity)


def _with_pose_faults(
    drive: Drive, duration_s: float, rough: Rough, rng: np.random.Generator
) -> tuple[PoseFix, Floats]:
    log, fixes = drive.log, drive.log.pose_fixes
    assert fixes is not None
    assert log.map_frame is not None
    motion = drive.truth.at(fixes.t_ns)
    s = seconds(log, fixes.t_ns)
    road = np.cumsum(np.diff(s, prepend=s[0]) * np.linalg.norm(motion.vel_enu, axis=1))
    sigmas = np.tile([*rough.sigmas[:2], np.radians(rough.sigmas[2])], (len(s), 1))
    sigmas[:, 0] *= np.clip(np.exp(0.4 * _along(rng, road, 80.0)), 0.4, 2.5)
    for begin, end in windows(rng, duration_s, rough.blind, (4.0, 10.0)):
        sigmas[(s >= begin) & (s < end), 0] = rng.uniform(0.5, 0.9)
    errors = np.empty((len(s), 3))
    for axis, share in enumerate(rough.correlated):
        slow = _along(rng, road, rough.correlation_m)
        errors[:, axis] = np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.standard_normal(len(s))
    errors *= sigmas
    for begin, _ in windows(rng, duration_s, rough.gross, (0.0, 0.0)):
        first = int(np.searchsorted(s, begin))
        burst = slice(first, first + rng.geometric(0.5))
        errors[burst] += [rng.normal(0.0, 3.0), rng.normal(), np.radians(rng.uniform(-10.0, 10.0))]
    for axis, period, rate, longest in ((0, 6.0, rough.dashes, 5.0), (1, 3.5, rough.lanes, 10.0)):
        for begin, end in windows(rng, duration_s, rate, (1.0, longest)):
            errors[(s >= begin) & (s < end), axis] += period * rng.choice([-1.0, 1.0]) * rng.integers(1, 3 - axis)
    yaw = yaw_from_q(attitude_in_map(motion, log.map_frame))
    axes = np.zeros((len(s), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(yaw)
    axes[:, 1, 0], axes[:, 0, 1], axes[:, 2, 2] = np.sin(yaw), -np.sin(yaw), 1.0
    place = map_from_llh(log.map_frame, motion.place_of(log.vehicle.pose_lever_arm))[:, :2]
    pose = np.column_stack((place, yaw)) + (axes @ errors[..., None])[..., 0]
    root = axes * sigmas[:, None, :]
    return replace(fixes, pose=pose, cov=root @ root.transpose(0, 2, 1)), errors


def _along(rng: np.random.Generator, road: Floats, length_m: float) -> Floats:
    """(N,) Gauss-Markov process of unit variance over metres of road (N,)."""
    step = 5.0
    process = rng.standard_normal(int(road[-1] / step) + 2)
    keep = np.exp(-step / length_m)
    for i in range(1, len(process)):
        process[i] = keep * process[i - 1] + np.sqrt(1.0 - keep * keep) * process[i]
    result: Floats = np.interp(road, np.arange(len(process)) * step, process)
    return result


def fused_errors(result: FusionResult, drive: Drive) -> Floats:
    """(N, 3) along and left of the true heading m, yaw deg."""
    motion = drive.truth.at(result.states.t_ns)
    enu = enu_from_llh(result.states.llh, motion.llh[0]) - enu_from_llh(motion.llh, motion.llh[0])
    yaw = yaw_from_q(motion.q_enu_body)
    along = np.cos(yaw) * enu[:, 0] + np.sin(yaw) * enu[:, 1]
    left = np.cos(yaw) * enu[:, 1] - np.sin(yaw) * enu[:, 0]
    turned = wrap(yaw_from_q(result.states.q_enu_body) - yaw)
    return np.column_stack((along, left, np.degrees(turned)))
