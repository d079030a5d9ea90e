"""Drives in which a naive way of gating fails: four minutes each, and what goes wrong in them."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.filter import Localizer
from fusion.state import LLH, QUATERNION, VELOCITY
from sensors.geodesy import map_from_llh, rotation_map_enu
from sensors.histogram import stated_covariance
from sensors.records import GnssStatus, Log, PoseFix
from sensors.rotation import matrix_from_q, wrap, yaw_from_q
from sensors.simulate.drive import Drive, simulate_drive
from sensors.simulate.gnss import displaced
from sensors.simulate.reference import attitude_in_map
from sensors.simulate.scenarios import load

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rng = np.random.Generator

DURATION_S = 240.0
WINDOWS = np.array([1.87, 0.935, 0.468])[:, None] * np.array([1.0, 1.0, np.radians(1.0)])
"""Sigmas of a flat histogram at the three levels: m, m, rad."""
SIGMA = np.array([0.05, 0.03, np.radians(0.13)])
"""Of a fix among landmarks, along, left and yaw, m, m, rad."""
DASH_M, LANE_M = 6.0, 3.5
STEP_M, STEP_DEG = 0.25, 0.25
"""Of a lattice whose cells a matcher does not interpolate."""
NOWHERE = (DURATION_S, DURATION_S)


class Method(NamedTuple):
    """A way of gating. careful: it looks at the covariance of every level of the histogram, else at the finest, and is
    told the lattice of a matcher that has one."""

    config: FusionConfig
    careful: bool = True


class Scene(NamedTuple):
    """What goes wrong, in a line, and the log of a seed as a method gets it; lattice: the fixes lie on one."""

    story: str
    log: Callable[[int, Method], Log]
    lattice: bool = False


def informed(scene: Scene, method: Method) -> Method:
    """The method with what it is told of the scene's matcher."""
    if not (scene.lattice and method.careful):
        return method
    pose = msgspec.structs.replace(method.config.pose, step_m=STEP_M, step_deg=STEP_DEG)
    return method._replace(config=msgspec.structs.replace(method.config, pose=pose))


def coarse_lattice(seed: int, _: Method) -> Log:
    """No GNSS for 170 s; fixes are the nodes of a lattice that lie nearest to what is seen, and claim a centimetre: of
    peaks that sharp the histogram shows one cell."""
    drive, _rng = _drive(seed)
    log = _without_gnss(drive.log, (50.0, 220.0))
    fixes = _fixes(log)
    step = np.array([STEP_M, STEP_M, np.radians(STEP_DEG)])
    claimed = np.tile(np.array([0.01, 0.01, np.radians(0.02)]), (len(fixes), 1))
    nodes = replace(fixes, pose=np.round(fixes.pose / step) * step, cov=_turned(_axes(drive, fixes), claimed))
    return replace(log, pose_fixes=nodes)


def flat_road(seed: int, method: Method) -> Log:
    """Nothing along the road for 90 s without GNSS: the coarse levels are flat there, so the finest one, around the
    filter's own prediction, finds a peak in whatever it sees."""
    drive, rng = _drive(seed, wheel=False)
    log = _without_gnss(drive.log, (60.0, 150.0))
    fixes = _fixes(log)
    s = _seconds(log, fixes.t_ns)
    blind = (s >= 60.0) & (s < 150.0)
    levels = np.tile(np.diag(SIGMA**2), (len(s), 3, 1, 1))
    levels[blind, :2, 0, 0] = (0.97 * WINDOWS[:2, 0]) ** 2
    levels[blind, 2, 0, 0] = 0.15**2
    axes = _axes(drive, fixes)
    levels = axes[:, None] @ levels @ axes[:, None].transpose(0, 1, 3, 2)
    cov = stated_covariance(levels, WINDOWS) if method.careful else levels[:, -1]
    return _fed_back(replace(log, pose_fixes=replace(fixes, cov=cov)), blind, rng.normal(0.0, 0.1, len(s)), method)


def blind_road(seed: int, method: Method) -> Log:
    """Nothing along the road for 90 s without GNSS, and the histogram says so: 0.46 m, around the prediction."""
    drive, rng = _drive(seed, wheel=False)
    log = _without_gnss(drive.log, (60.0, 150.0))
    fixes, axes = _fixes(log), _axes(drive, _fixes(log))
    s = _seconds(log, fixes.t_ns)
    blind = (s >= 60.0) & (s < 150.0)
    sigma = np.where(blind[:, None], np.array([0.46, *SIGMA[1:]]), SIGMA)
    log = replace(log, pose_fixes=replace(fixes, cov=_turned(axes, sigma)))
    return _fed_back(log, blind, rng.normal(0.0, 0.1, len(s)), method)


def tunnel(seed: int, _: Method) -> Log:
    """No GNSS for 130 s and no wheel; three times no fixes for 25 s, then dash aliases for five, with the truth as the
    weaker of two modes."""
    drive, rng = _drive(seed, wheel=False)
    log = _without_gnss(drive.log, (50.0, 180.0))
    fixes = _fixes(log)
    s = _seconds(log, fixes.t_ns)
    dark = np.zeros(len(s), bool)
    off = np.zeros((len(s), 3))
    for begin in (50.0, 95.0, 140.0):
        dark |= (s >= begin) & (s < begin + 25.0)
        aliased = (s >= begin + 25.0) & (s < begin + 30.0)
        off[aliased, 0] = DASH_M * rng.choice((-1.0, 1.0))
    return replace(log, pose_fixes=_moved(drive, fixes, off, told=0.7)[~dark])


def lane(seed: int, _: Method) -> Log:
    """Fixes one lane off, steadily, for 170 s without GNSS; nothing tells of a second mode."""
    drive, rng = _drive(seed)
    log = _without_gnss(drive.log, (50.0, 225.0))
    s = _seconds(log, _fixes(log).t_ns)
    aliased = (s >= 52.0) & (s < 222.0)
    off = np.where(aliased[:, None], np.array([0.0, LANE_M * rng.choice((-1.0, 1.0)), 0.0]), 0.0)
    return replace(log, pose_fixes=_moved(drive, _fixes(log), off))


def gross(seed: int, _: Method) -> Log:
    """Bursts of a few frames, metres and ten degrees off, with the usual covariance, every ten seconds or so."""
    drive, rng = _drive(seed)
    fixes = _fixes(drive.log)
    off = np.zeros((len(fixes), 3))
    for row in np.flatnonzero(rng.random(len(fixes)) < 0.01):
        burst = slice(row, row + rng.geometric(0.3))
        off[burst] = [rng.normal(0.0, 2.0), rng.normal(0.0, 0.7), np.radians(rng.uniform(-15.0, 15.0))]
    return replace(drive.log, pose_fixes=_moved(drive, fixes, off))


def wrong_fix(seed: int, _: Method) -> Log:
    """After 40 s without GNSS its ambiguities are fixed wrongly: one to four metres off with 1.5 cm, for a minute."""
    drive, rng = _drive(seed)
    log = _without_gnss(drive.log, (50.0, 90.0))
    angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(1.0, 4.0)
    offset = np.array([far * np.cos(angle), far * np.sin(angle), rng.normal(0.0, 2.0)])
    return _gnss_off(log, (90.0, 150.0), lambda n: np.tile(offset, (n, 1)), GnssStatus.FIXED, 0.015)


def canyon(seed: int, _: Method) -> Log:
    """GNSS alone, as float with 0.2 m: every third fix is a reflection, 1 to 1.6 m to the same side for half a minute,
    which passes the gate."""
    drive, rng = _drive(seed)

    def reflected(count: int) -> Floats:
        side = rng.uniform(-np.pi, np.pi, count // 300 + 1)[np.arange(count) // 300]
        size = np.where(rng.random(count) < 1.0 / 3.0, rng.uniform(1.0, 1.6, count), 0.0)
        return np.stack((size * np.cos(side), size * np.sin(side), 0.0 * size), axis=-1)

    return _gnss_off(replace(drive.log, pose_fixes=None), (30.0, 230.0), reflected, GnssStatus.FLOAT, 0.2)


SCENES = {
    "coarse lattice": Scene(
        "170 s without GNSS; fixes are the nodes of a lattice of 0.25 m and deg, and claim 1 cm", coarse_lattice, True
    ),
    "flat coarse levels": Scene(
        "90 s without landmarks along the road, GNSS, wheel: only coarse levels show it", flat_road
    ),
    "flat histogram": Scene("the same, where the finest level is flat as well: 0.46 m", blind_road),
    "dash aliases": Scene("no GNSS, no wheel; 25 s without fixes, then 5 s a dash off with two modes told", tunnel),
    "steady lane alias": Scene("a lane off for 170 s without GNSS, no modes told", lane),
    "gross frames": Scene("bursts metres and ten degrees off, with the usual covariance", gross),
    "wrong RTK fix": Scene("1 to 4 m off with 1.5 cm for 60 s, after 40 s without GNSS", wrong_fix),
    "reflections": Scene("GNSS float alone, every third fix 1 to 1.6 m to one side", canyon),
}


@lru_cache(maxsize=2)
def _simulated(seed: int, wheel: bool) -> Drive:
    """Without a wheel there are no red lights either: nothing but fixes tells of the way along the road."""
    scenario = load("clean")
    if not wheel:
        no_wheel = msgspec.structs.replace(scenario.wheel, use=False)
        no_lights = msgspec.structs.replace(scenario.city, stop_probability=0.0)
        scenario = msgspec.structs.replace(scenario, wheel=no_wheel, city=no_lights)
    return simulate_drive(DURATION_S, seed, scenario)


def _drive(seed: int, *, wheel: bool = True) -> tuple[Drive, Rng]:
    """A city drive whose sensors do as they state, and the numbers of what befalls it."""
    return _simulated(seed, wheel), np.random.default_rng([seed, 4])


def _fixes(log: Log) -> PoseFix:
    assert log.pose_fixes is not None
    return log.pose_fixes


def _seconds(log: Log, t_ns: NDArray[np.int64]) -> Floats:
    """Since the first IMU sample."""
    assert log.imu is not None
    result: Floats = (t_ns - log.imu.t_ns[0]) * 1e-9
    return result


def _without_gnss(log: Log, span_s: tuple[float, float]) -> Log:
    kept = {}
    for name in ("gnss", "gnss_velocity"):
        record = getattr(log, name)
        s = _seconds(log, record.t_ns)
        kept[name] = record[(s < span_s[0]) | (s >= span_s[1])]
    return replace(log, **kept)


def _gnss_off(
    log: Log, span_s: tuple[float, float], offsets: Callable[[int], Floats], status: GnssStatus, sigma: float
) -> Log:
    """GNSS displaced by offsets(count) (count, 3) ENU m over a while, with the status and sigma that it then claims."""
    fixes = log.gnss
    assert fixes is not None
    s = _seconds(log, fixes.t_ns)
    rows = np.flatnonzero((s >= span_s[0]) & (s < span_s[1]))
    llh, cov, told = fixes.llh.copy(), fixes.cov_enu.copy(), fixes.status.copy()
    llh[rows] = displaced(llh[rows], offsets(len(rows)))
    cov[rows], told[rows] = np.diag([sigma, sigma, 1.8 * sigma]) ** 2, status
    return replace(log, gnss=replace(fixes, llh=llh, cov_enu=cov, status=told))


def _axes(drive: Drive, fixes: PoseFix) -> Floats:
    """(N, 3, 3) from along, left, yaw to map axes, at the true yaw."""
    assert drive.log.map_frame is not None
    yaw = yaw_from_q(attitude_in_map(drive.truth.at(fixes.t_ns), drive.log.map_frame))
    axes = np.zeros((len(fixes), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(yaw)
    axes[:, 1, 0], axes[:, 0, 1], axes[:, 2, 2] = np.sin(yaw), -np.sin(yaw), 1.0
    return axes


def _turned(axes: Floats, sigma: Floats) -> Floats:
    """(N, 3, 3) covariances of sigmas (N, 3) along, left, yaw."""
    root = axes * sigma[:, None, :]
    result: Floats = root @ root.transpose(0, 2, 1)
    return result


def _moved(drive: Drive, fixes: PoseFix, off: Floats, told: float | None = None) -> PoseFix:
    """Fixes displaced by off (N, 3) along, left, yaw; told: mass of the wrong mode, where both are told."""
    pose = fixes.pose + (_axes(drive, fixes) @ off[..., None])[..., 0]
    moved = replace(fixes, pose=pose)
    if told is None:
        return moved
    wrong = np.any(off != 0.0, axis=1, keepdims=True)
    modes = np.where(wrong[:, :, None], np.stack((pose, fixes.pose), axis=1), np.nan)
    return replace(moved, modes=modes, weights=np.where(wrong, [told, 1.0 - told], 0.0))


def _fed_back(log: Log, blind: Mask, noise: Floats, method: Method) -> Log:
    """The log as the method's filter causes it: where it is blind (N,) a fix's place along the road is the filter's own
    prediction, plus noise (N,) m. A replay of it gives the same states, since streaming equals batch."""
    fixes, frame, imu = _fixes(log), log.map_frame, log.imu
    assert frame is not None
    assert imu is not None
    localizer = Localizer(log.vehicle, frame, method.config)
    for name in ("gnss", "gnss_velocity"):
        localizer.push(getattr(log, name))
    pose, arm = fixes.pose.copy(), np.array(log.vehicle.pose_lever_arm)
    last = np.searchsorted(imu.t_ns, fixes.t_ns)  # samples before each fix
    begin, *_, end = np.flatnonzero(blind).tolist()
    localizer.push(fixes[:begin])
    localizer.push(imu[: last[begin]])
    for k in range(begin, end + 1):
        localizer.push(imu[last[max(k - 1, begin)] : last[k]])
        core, t_ns = localizer.core, localizer.t_ns
        assert core is not None
        assert t_ns is not None
        if blind[k]:
            here, age = core.nav[None, LLH], (fixes.t_ns[k] - t_ns) * 1e-9
            seen = matrix_from_q(core.nav[QUATERNION]) @ arm + age * core.nav[VELOCITY]
            place = map_from_llh(frame, here)[0] + rotation_map_enu(frame, here)[0][0] @ seen
            ahead = np.array([np.cos(pose[k, 2]), np.sin(pose[k, 2])])
            pose[k, :2] += ahead * (ahead @ (place[:2] - pose[k, :2]) + noise[k])
        localizer.push(replace(fixes[k : k + 1], pose=pose[k : k + 1]))
    pose[:, 2] = wrap(pose[:, 2])
    return replace(log, pose_fixes=replace(fixes, pose=pose))
