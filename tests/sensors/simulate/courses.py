"""Hand-made courses, truths and a silent IMU for tests of single sensor models."""

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.course import Course
from sensors.simulate.environment import Environment
from sensors.simulate.noise import GaussMarkov
from sensors.simulate.trajectory import KNOT_S, MARGIN_S, Profile, Truth
from sensors.vehicle import ImuSpec

START_NS = 1_700_000_000_000_000_000
MAP_SCALE_M = 300.0
QUIET = ImuSpec(
    gyro_noise_deg_per_sqrt_h=0.0,
    accel_noise_m_per_s_per_sqrt_h=0.0,
    gyro_bias_instability_deg_per_h=0.0,
    accel_bias_instability_mg=0.0,
    gyro_turn_on_bias_deg_per_h=0.0,
    accel_turn_on_bias_mg=0.0,
)


def straight(duration_s: float, speed: float = 10.0, *parts: tuple[float, str, Environment], seed: int = 0) -> Course:
    """A course at constant speed; parts: (where it ends in m, scene tag, environment), one after the other."""
    s = speed * np.arange(int(duration_s) + 1.0)
    given = parts or ((max(s[-1], 1.0), "city", Environment()),)
    names = tuple(dict.fromkeys(name for _, name, _ in given))
    around = {name: environment for _, name, environment in given}
    bias_at = np.arange(0.0, s[-1] + 20.0, 10.0)
    return Course(
        t_ns=START_NS + np.arange(len(s)) * 1_000_000_000,
        s=s,
        names=names,
        environments=tuple(around[name] for name in names),
        edges=np.array([0.0, *(end for end, _, _ in given)]),
        kind=np.array([names.index(name) for _, name, _ in given]),
        bias_at=bias_at,
        bias=GaussMarkov(np.random.default_rng([seed, 99]), 3, 10.0, MAP_SCALE_M).rows(len(bias_at)),
    )


def cruise(duration_s: float, speed: float = 10.0, *, yaw: float = 0.3) -> Truth:
    """Level motion straight on at constant speed."""
    count = round((duration_s + 2 * MARGIN_S) / KNOT_S) + 6
    level = np.zeros(count)
    profile = Profile(-MARGIN_S, np.full(count, speed), np.full(count, yaw), level, level)
    return Truth(profile, (np.radians(48.1), np.radians(11.6), 500.0), START_NS)


def epochs(duration_s: float, rate_hz: float) -> NDArray[np.int64]:
    return START_NS + np.rint(np.arange(int(duration_s * rate_hz) + 1) * (1e9 / rate_hz)).astype(np.int64)
