"""How a state that must be wrong gives way: P widens to what contradicts it."""

import math

from fusion.state import E_WHEEL_SCALE, Floats
from sensors.kernel import kernel

VELOCITY_VAR = 1.0**2
"""Doubt of the velocity, (m/s)^2."""
ATTITUDE_VAR = 0.02**2
"""Doubt of the attitude, rad^2."""
TILT_PER_SPEED = 1.0 / 20.0
"""Velocity that is off by so much comes of such a tilt over the two seconds that a vote takes, rad per m/s."""
MOST_TILT_VAR = 0.5**2
"""But of no more than this, rad^2."""
ALONE_DOUBLING_S = 4.0
"""GNSS alone, rejected all the time: the state's sigmas double in this time."""
GYRO_BIAS_WALK, ACCEL_BIAS_WALK = 0.0002, 0.02
"""As long as GNSS alone contradicts the state the IMU's biases may change so fast, rad/s and m/s^2 per sqrt(s)."""
GYRO_BIAS_VAR = 0.0005**2
"""Doubt of the gyro's bias, (rad/s)^2."""
ACCEL_BIAS_VAR = 0.05**2
"""Doubt of the accelerometer's bias, (m/s^2)^2."""
WHEEL_SCALE_VAR = 0.02**2
"""Doubt of the wheel's scale."""
UPWARDS_RATE = 10.0
"""Rejections of a receiver come so often, roughly: how far the height runs away between two tells its speed, 1/s."""
UPWARDS_BIAS_VAR = 0.3**2
"""Doubt of the vertical accelerometer's bias where the height ran away, (m/s^2)^2."""


@kernel()
def forget(P: Floats, seconds: float, moving: bool) -> None:
    """Widen position, velocity and attitude for the time that GNSS alone has contradicted them, and the IMU's biases.

    moving: else the yaw is left, since positions of a vehicle that stands say nothing of it. A bias that has changed
    widens it none the less, by the time it lasts; at rest, where zero rates show the gyro's, not at all.
    """
    grown = 4.0 ** (seconds / ALONE_DOUBLING_S)
    count = 9 if moving else 8
    for i in range(count):
        for j in range(count):
            P[i, j] *= grown
    for i in range(3):
        P[9 + i, 9 + i] += GYRO_BIAS_WALK**2 * seconds
        P[12 + i, 12 + i] += ACCEL_BIAS_WALK**2 * seconds


@kernel()
def doubt_all(P: Floats) -> None:
    """Widen what a wrong state has been taken in by: tilt, biases, the wheel's scale."""
    for i in range(3):
        P[6 + i, 6 + i] += ATTITUDE_VAR
        P[9 + i, 9 + i] += GYRO_BIAS_VAR
        P[12 + i, 12 + i] += ACCEL_BIAS_VAR
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += WHEEL_SCALE_VAR


@kernel()
def give_way(P: Floats, doubt: Floats) -> None:
    """Widen P to what both sensors say: how far off the state is, and how fast it runs away."""
    place = doubt[1, 0] * doubt[1, 0] + doubt[1, 1] * doubt[1, 1]
    P[0, 0] += place
    P[1, 1] += place
    P[2, 2] += doubt[0, 2] * doubt[0, 2]
    run = doubt[0, 6] * doubt[0, 6] + doubt[0, 7] * doubt[0, 7]
    for i in range(3):
        P[3 + i, 3 + i] += VELOCITY_VAR + run
        P[6 + i, 6 + i] += min(run * TILT_PER_SPEED * TILT_PER_SPEED, MOST_TILT_VAR)
    doubt_all(P)
    P[8, 8] += doubt[1, 2] * doubt[1, 2]


@kernel()
def give_way_nearby(P: Floats, place_var: float, yaw_var: float) -> None:
    """Widen place and yaw by so much, m^2, rad^2, the velocity, which went along, and what was taken in by it."""
    for i in range(2):
        P[i, i] += place_var
    for i in range(3):
        P[3 + i, 3 + i] += VELOCITY_VAR
    doubt_all(P)
    P[8, 8] += yaw_var


@kernel()
def give_way_turning(P: Floats, turn: float) -> None:
    """Widen the yaw by how far it is off, rad, the gyro's bias, which may have turned it while votes were counted, the
    tilt, which went through the same turn, and the scale of the wheel, which was learned across the vehicle's axis."""
    P[8, 8] += turn * turn + ATTITUDE_VAR
    P[11, 11] += 0.25 * turn * turn
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += (1.0 - math.cos(turn)) ** 2 + WHEEL_SCALE_VAR
    P[6, 6] += ATTITUDE_VAR
    P[7, 7] += ATTITUDE_VAR


@kernel()
def give_way_upwards(P: Floats, up: float, climb: float) -> None:
    """Widen the height by how far it is off, m, the rest by what may have caused it. climb: since the last, m."""
    P[2, 2] += up * up
    P[5, 5] += VELOCITY_VAR + (climb * UPWARDS_RATE) ** 2
    P[14, 14] += UPWARDS_BIAS_VAR
