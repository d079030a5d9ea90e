"""Strapdown integration on WGS-84 and the slow terms of its error dynamics (Groves 2013, ch. 5.4 and 14.2, in ENU)."""

import math

from fusion._linalg import Quaternion, Vector, axpy, cross, exp_q, multiply, normalize
from fusion.state import (
    G_AGE,
    G_COS,
    G_HEIGHT,
    G_MERIDIAN,
    G_NORTH,
    G_SIN,
    G_TRANSVERSE,
    G_UP,
    Floats,
)
from sensors._kernels import EARTH_RATE, gravity_enu, radii
from sensors.kernel import kernel

MAX_AGE = 5
"""Radii of curvature and gravity are refreshed after so many steps."""
GRAVITY_GRADIENT = 3.086e-6
"""Fall of gravity with height, 1/s^2 (free air)."""


@kernel()
def increments(w0: Vector, w1: Vector, f0: Vector, f1: Vector, dt: float) -> tuple[Vector, Vector]:
    """Rotation vector and velocity increment (axes at the start) over dt, rates and forces linear in between.

    Coning dt^2/12 w0 x w1 and sculling dt^2/12 (w0 x f1 + f0 x w1) (Savage 1998); exact to dt^4 for linear signals.
    """
    turn = (0.5 * dt * (w0[0] + w1[0]), 0.5 * dt * (w0[1] + w1[1]), 0.5 * dt * (w0[2] + w1[2]))
    push = (0.5 * dt * (f0[0] + f1[0]), 0.5 * dt * (f0[1] + f1[1]), 0.5 * dt * (f0[2] + f1[2]))
    k = dt * dt / 12.0
    turned = cross(turn, push)
    dv = axpy(k, cross(f0, w1), axpy(k, cross(w0, f1), axpy(0.5, turned, push)))
    return axpy(k, cross(w0, w1), turn), axpy(1.0 / 6.0, cross(turn, turned), dv)


@kernel()
def refresh(nav: Floats, earth: Floats) -> None:
    """Recompute what depends on the place (G_*): radii of curvature and gravity there."""
    sin_lat, cos_lat, height = math.sin(nav[0]), math.cos(nav[0]), nav[2]
    meridian, transverse = radii(sin_lat)
    north, up = gravity_enu(sin_lat, cos_lat, height)
    earth[G_SIN], earth[G_COS] = sin_lat, cos_lat
    earth[G_MERIDIAN], earth[G_TRANSVERSE] = 1.0 / (meridian + height), 1.0 / (transverse + height)
    earth[G_NORTH], earth[G_UP], earth[G_HEIGHT] = north, up, height
    earth[G_AGE] = 0.0


@kernel()
def strapdown(nav: Floats, earth: Floats, turn: Vector, dv: Vector, dt: float) -> None:
    """Advance nav (17,) in place by dt.

    turn: rotation vector of the body against inertial space, body axes; dv: specific force integrated, ENU axes at the
    start. Second order in dt: Coriolis, transport and gravity at mid-step, position by the trapezoid of velocity.
    Latitude's sine and cosine follow by first-order steps; radii and gravity wait for ``refresh``.
    """
    if earth[G_AGE] >= MAX_AGE:
        refresh(nav, earth)
    earth[G_AGE] += 1.0
    sin_lat, cos_lat, m, n = earth[G_SIN], earth[G_COS], earth[G_MERIDIAN], earth[G_TRANSVERSE]
    half = 0.5 * dt
    secant = 1.0 / cos_lat
    g_north = earth[G_NORTH]
    g_up = earth[G_UP] + GRAVITY_GRADIENT * (nav[2] - earth[G_HEIGHT] + half * nav[5])

    middle: Vector = (nav[3] + 0.5 * dv[0], nav[4] + 0.5 * dv[1] + half * g_north, nav[5] + 0.5 * dv[2] + half * g_up)
    east_rate = middle[0] * n
    w_ie: Vector = (0.0, EARTH_RATE * cos_lat, EARTH_RATE * sin_lat)
    w_in = axpy(1.0, w_ie, (-middle[1] * m, east_rate, east_rate * sin_lat * secant))
    coriolis = cross(axpy(1.0, w_ie, w_in), middle)
    tilted = cross(w_in, dv)
    ve = nav[3] + dv[0] - half * tilted[0] - coriolis[0] * dt
    vn = nav[4] + dv[1] - half * tilted[1] + (g_north - coriolis[1]) * dt
    vu = nav[5] + dv[2] - half * tilted[2] + (g_up - coriolis[2]) * dt

    rise = half * (nav[5] + vu)
    above = nav[2] - earth[G_HEIGHT] + 0.5 * rise
    dlat = half * (nav[4] + vn) * m * (1.0 - above * m)
    nav[0] += dlat
    nav[1] += half * (nav[3] + ve) * n * (1.0 - above * n) * secant * (1.0 + 0.5 * sin_lat * secant * dlat)
    nav[2] += rise
    nav[3], nav[4], nav[5] = ve, vn, vu
    earth[G_SIN], earth[G_COS] = sin_lat + cos_lat * dlat, cos_lat - sin_lat * dlat

    q: Quaternion = (nav[6], nav[7], nav[8], nav[9])
    frame = exp_q((-w_in[0] * dt, -w_in[1] * dt, -w_in[2] * dt))
    nav[6], nav[7], nav[8], nav[9] = normalize(multiply(frame, multiply(q, exp_q(turn))))


@kernel()
def slow_dynamics(nav: Floats, earth: Floats, t: float, F: Floats) -> None:
    """Write I + t times the slow part of the error dynamics into F[:9, :9]: earth, transport and gravity terms.

    Left out here: position against velocity (identity) and all that the IMU's samples enter, which ``covariance`` sums
    step by step. The change of the radii of curvature with latitude (0.3 % of these terms) is neglected.
    """
    ve, vn, vu = nav[3], nav[4], nav[5]
    sin_lat, cos_lat = earth[G_SIN], earth[G_COS]
    secant = 1.0 / cos_lat
    tan_lat = sin_lat * secant
    m, n = earth[G_MERIDIAN], earth[G_TRANSVERSE]
    e_rate, n_rate = ve * n, vn * m
    ie_n, ie_u = EARTH_RATE * cos_lat, EARTH_RATE * sin_lat
    for i in range(9):
        for j in range(9):
            F[i, j] = 0.0

    # position: ENU axes turn with the motion
    F[0, 0] = 1.0 + t * (vu * n - tan_lat * n_rate)
    F[0, 1] = t * ve * tan_lat * m
    F[0, 2] = -t * e_rate
    F[1, 1] = 1.0 + t * vu * m
    F[1, 2] = -t * n_rate
    F[2, 2] = 1.0

    # velocity against position: earth rate and transport rate change with latitude and height, gravity with height
    wu_lat = (2.0 * ie_n + e_rate * secant * secant) * m
    wn_lat = -2.0 * ie_u * m
    F[3, 1] = t * (wu_lat * vn - wn_lat * vu)
    F[4, 1] = -t * wu_lat * ve
    F[5, 1] = t * wn_lat * ve
    F[3, 2] = -t * (e_rate * tan_lat * vn - e_rate * vu) * n
    F[4, 2] = t * (e_rate * tan_lat * ve * n + n_rate * vu * m)
    F[5, 2] = t * (GRAVITY_GRADIENT - e_rate * ve * n - n_rate * vn * m)

    # velocity against velocity: Coriolis and transport
    F[3, 3] = 1.0 + t * (vn * tan_lat - vu) * n
    F[3, 4] = t * (2.0 * ie_u + e_rate * tan_lat)
    F[3, 5] = -t * (2.0 * ie_n + e_rate)
    F[4, 3] = -t * (2.0 * ie_u + 2.0 * e_rate * tan_lat)
    F[4, 4] = 1.0 - t * vu * m
    F[4, 5] = -t * n_rate
    F[5, 3] = 2.0 * t * (ie_n + e_rate)
    F[5, 4] = 2.0 * t * n_rate
    F[5, 5] = 1.0

    # attitude: the navigation frame turns by w_in, and w_in depends on position and velocity
    F[6, 2] = -t * n_rate * m
    F[7, 1] = t * ie_u * m
    F[7, 2] = t * e_rate * n
    F[8, 1] = -t * (ie_n + e_rate * secant * secant) * m
    F[8, 2] = t * e_rate * tan_lat * n
    F[6, 4] = t * m
    F[7, 3] = -t * n
    F[8, 3] = -t * tan_lat * n
    w_e, w_n, w_u = -t * n_rate, t * (ie_n + e_rate), t * (ie_u + e_rate * tan_lat)
    F[6, 6] = F[7, 7] = F[8, 8] = 1.0
    F[6, 7], F[6, 8] = w_u, -w_n
    F[7, 6], F[7, 8] = -w_u, w_e
    F[8, 6], F[8, 7] = w_n, -w_e
