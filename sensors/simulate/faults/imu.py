"""Faults of the IMU: without it nothing moves the state."""

import numpy as np

from sensors.simulate.faults.fault import (
    During,
    Fault,
    Floats,
    Rows,
    ahead,
    duplicated,
    lost,
    spoilt,
    stuck,
    thinned,
)

DEG = np.pi / 180


def _added(rows: Rows, gyro: Floats | float, accel: Floats | float) -> Rows:
    return rows.having(gyro=rows.columns["gyro"] + gyro, accel=rows.columns["accel"] + accel)


def _spiked(rows: Rows, during: During) -> Rows:
    """The first sample is off on all axes: force by the size, m/s^2, rate by a twentieth of it, rad/s."""
    first = np.where(during.number == 0, during.size, 0.0)[:, None]
    return _added(rows, first / 20.0, first)


def _saturated(rows: Rows, during: During) -> Rows:
    """Rates end at the size, deg/s, horizontal forces at a fifth of it, m/s^2."""
    accel = rows.columns["accel"].copy()
    accel[:, :2] = np.clip(accel[:, :2], -during.size / 5.0, during.size / 5.0)
    limit = during.size * DEG
    return rows.having(gyro=np.clip(rows.columns["gyro"], -limit, limit), accel=accel)


def _gyro_biased(rows: Rows, during: During) -> Rows:
    return _added(rows, during.size * DEG, 0.0)


def _accel_biased(rows: Rows, during: During) -> Rows:
    return _added(rows, 0.0, during.size)


def _flipped(rows: Rows, during: During) -> Rows:
    """1: the force to the left, 2: the force ahead, 3: the turn rate changes its sign."""
    gyro, accel = rows.columns["gyro"].copy(), rows.columns["accel"].copy()
    column = {1: accel[:, 1], 2: accel[:, 0], 3: gyro[:, 2]}[round(during.size)]
    column *= -1.0
    return rows.having(gyro=gyro, accel=accel)


def _scaled(rows: Rows, during: During) -> Rows:
    return rows.having(gyro=rows.columns["gyro"] * during.size, accel=rows.columns["accel"] * during.size)


def _noisy(rows: Rows, during: During) -> Rows:
    """White noise of the size: m/s^2, and deg/s."""
    noise = during.size * during.rng.standard_normal((len(rows.true_ns), 6))
    return _added(rows, DEG * noise[:, :3], noise[:, 3:])


FAULTS = (
    Fault(
        "imu-spike",
        "one sample is {} off on all axes",
        {"imu": _spiked},
        (20.0, 100.0, 900.0),
        (1.0,) * 3,
        words=("20 m/s^2 and 1 rad/s", "100 m/s^2 and 5 rad/s", "900 m/s^2 and 45 rad/s"),
    ),
    Fault(
        "imu-saturation",
        "nothing above {} is measured",
        {"imu": _saturated},
        (10.0, 5.0, 2.0),
        (30.0,) * 3,
        words=("10 deg/s and 2 m/s^2", "5 deg/s and 1 m/s^2", "2 deg/s and 0.4 m/s^2"),
    ),
    Fault("imu-dropout", "nothing for {}", {"imu": lost}, None, (0.1, 1.0, 10.0)),
    Fault("imu-thinned", "one sample of {} comes", {"imu": thinned}, (2.0, 5.0, 20.0)),
    Fault("imu-stuck", "values stay the same for {}", {"imu": stuck("gyro", "accel")}, None, (0.2, 1.0, 5.0)),
    Fault(
        "imu-gyro-bias", "biases jump by {} on all axes", {"imu": _gyro_biased}, (0.05, 0.3, 2.0), (30.0,) * 3, "deg/s"
    ),
    Fault(
        "imu-accel-bias",
        "biases jump by {} on all axes",
        {"imu": _accel_biased},
        (0.05, 0.2, 1.0),
        (30.0,) * 3,
        "m/s^2",
    ),
    Fault(
        "imu-axis-flip",
        "{} has the wrong sign",
        {"imu": _flipped},
        (1.0, 2.0, 3.0),
        (10.0,) * 3,
        words=("the force to the left", "the force ahead", "the turn rate"),
    ),
    Fault("imu-scale", "rates and forces are {} too large", {"imu": _scaled}, (1.01, 1.05, 1.3), unit="times"),
    Fault("imu-noise", "white noise of {} on all axes", {"imu": _noisy}, (0.2, 1.0, 5.0), unit="deg/s and m/s^2"),
    Fault("imu-time-jump", "stamps run {} ahead", {"imu": ahead}, (0.1, 0.5, 2.0), unit="s"),
    Fault("imu-duplicates", "every sample comes {}", {"imu": duplicated}, (2.0, 5.0, 10.0), unit="times"),
    Fault(
        "imu-nan",
        "{} has no numbers",
        {"imu": spoilt("gyro", np.nan)},
        (100.0, 10.0, 2.0),
        words=("one sample of a hundred", "one sample of ten", "every second sample"),
    ),
)
