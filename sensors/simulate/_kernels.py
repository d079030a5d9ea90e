"""Kernels of the simulated truth: piecewise polynomials over spline knots. Arrays in and out, no config.

Tables: shape (K, 4, 6) speed, yaw, grade, roll; place (K, 3, D) latitude, longitude, height; row k is the interval
[start + k step, start + (k + 1) step], its polynomials ascending in z in [-1, 1].
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors._kernels import EARTH_RATE, gravity_enu, radii
from sensors.kernel import kernel

Floats = NDArray[np.float64]


@kernel(allocates=True, inline="always")
def _value(c: Any, z: float) -> float:
    """Horner's rule."""
    p = 0.0
    for k in range(len(c) - 1, -1, -1):
        p = p * z + c[k]
    return p


@kernel(allocates=True, inline="always")
def _with_slope(c: Any, z: float) -> tuple[float, float]:
    """Value and derivative with respect to z."""
    p, d = 0.0, 0.0
    for k in range(len(c) - 1, -1, -1):
        d = d * z + p
        p = p * z + c[k]
    return p, d


@kernel(allocates=True)
def integrate_place(
    shape: Floats, llh: Floats, step: float, nodes: Floats, weights: Floats, at_nodes: Floats, powers: Floats
) -> Floats:
    """The place table: lat' = vn/(RM+h), lon' = ve/((RN+h) cos lat), h' = vu by Gauss collocation on each interval.

    at_nodes: (S, S) integrals from -1 to each node; powers: (S + 1, S) the same integrals as polynomials in z.
    """
    count, stages = len(shape), len(nodes)
    table = np.empty((count, 3, stages + 1))
    north, east, up = np.empty(stages), np.empty(stages), np.empty(stages)
    lat_rate, lon_rate = np.empty(stages), np.empty(stages)
    lat, lon, h = llh[0], llh[1], llh[2]
    half = 0.5 * step
    for k in range(count):
        for g in range(stages):
            v = _value(shape[k, 0], nodes[g]) * half
            yaw = _value(shape[k, 1], nodes[g])
            grade = _value(shape[k, 2], nodes[g])
            north[g] = v * math.cos(grade) * math.sin(yaw)
            east[g] = v * math.cos(grade) * math.cos(yaw)
            up[g] = v * math.sin(grade)
        # the rates hardly depend on the place: each round gains six digits
        lat_rate[:] = 0.0
        for _ in range(3):
            for g in range(stages):
                lat_g, h_g = lat, h
                for j in range(stages):
                    lat_g += at_nodes[g, j] * lat_rate[j]
                    h_g += at_nodes[g, j] * up[j]
                meridian, transverse = radii(math.sin(lat_g))
                lon_rate[g] = east[g] / ((transverse + h_g) * math.cos(lat_g))
                north_g = north[g] / (meridian + h_g)
                lat_rate[g] = north_g
        for d in range(stages + 1):
            a, b, c = 0.0, 0.0, 0.0
            for j in range(stages):
                a += powers[d, j] * lat_rate[j]
                b += powers[d, j] * lon_rate[j]
                c += powers[d, j] * up[j]
            table[k, 0, d], table[k, 1, d], table[k, 2, d] = a, b, c
        table[k, 0, 0] += lat
        table[k, 1, 0] += lon
        table[k, 2, 0] += h
        for j in range(stages):
            lat += weights[j] * lat_rate[j]
            lon += weights[j] * lon_rate[j]
            h += weights[j] * up[j]
    return table


@kernel(allocates=True, inline="always")
def _inertial(shape: Any, place: Any, z: float, slope: float) -> tuple[float, float, float, float, float, float]:
    """Rate against inertial space, rad/s, and specific force, m/s^2, in body axes (Groves 2013, Eq. 5.44 and 5.53)."""
    v, dv = _with_slope(shape[0], z)
    yaw, dyaw = _with_slope(shape[1], z)
    grade, dgrade = _with_slope(shape[2], z)
    roll, droll = _with_slope(shape[3], z)
    dv, dyaw, dgrade, droll = dv * slope, dyaw * slope, dgrade * slope, droll * slope
    lat, h = _value(place[0], z), _value(place[2], z)
    sy, cy, sg, cg = math.sin(yaw), math.cos(yaw), math.sin(grade), math.cos(grade)
    sr, cr, sl, cl = math.sin(roll), math.cos(roll), math.sin(lat), math.cos(lat)
    east, north, up = v * cy * cg, v * sy * cg, v * sg
    meridian, transverse = radii(sl)
    # earth rate and transport rate in ENU
    earth_n, earth_u = EARTH_RATE * cl, EARTH_RATE * sl
    t_e, t_n = -north / (meridian + h), east / (transverse + h)
    t_u = t_n * sl / cl
    # acceleration of the ENU velocity, Coriolis, gravity
    level = dv * cg - v * sg * dgrade
    g_n, g_u = gravity_enu(sl, cl, h)
    c_e, c_n, c_u = t_e, 2 * earth_n + t_n, 2 * earth_u + t_u
    f_e = level * cy - v * cg * sy * dyaw + c_n * up - c_u * north
    f_n = level * sy + v * cg * cy * dyaw + c_u * east - c_e * up - g_n
    f_u = dv * sg + v * cg * dgrade + c_e * north - c_n * east - g_u
    w_e, w_n, w_u = t_e, earth_n + t_n, earth_u + t_u
    # into the body: yaw, then pitch = -grade, then roll
    f1, f2 = cy * f_e + sy * f_n, cy * f_n - sy * f_e
    w1, w2 = cy * w_e + sy * w_n, cy * w_n - sy * w_e
    f1, f3 = cg * f1 + sg * f_u, cg * f_u - sg * f1
    w1, w3 = cg * w1 + sg * w_u, cg * w_u - sg * w1
    w1, w2, w3 = w1 + dyaw * sg, w2 - dgrade, w3 + dyaw * cg
    return droll + w1, cr * w2 + sr * w3, cr * w3 - sr * w2, f1, cr * f2 + sr * f3, cr * f3 - sr * f2


@kernel(allocates=True, inline="always")
def _locate(t: float, start: float, step: float, count: int) -> tuple[int, float]:
    """Interval that holds a time, and z in it."""
    u = (t - start) / step
    k = min(max(int(u), 0), count - 1)
    return k, 2.0 * (u - k) - 1.0


@kernel(allocates=True)
def inertial_means(
    shape: Floats,
    place: Floats,
    start: float,
    step: float,
    t: Floats,
    nodes: Floats,
    weights: Floats,
    gyro: Floats,
    accel: Floats,
) -> None:
    """Write rate and specific force at times t (N,), averaged over t + nodes (G,) with weights (G,) that sum to one."""
    for i in range(len(t)):
        for g in range(len(weights)):
            k, z = _locate(t[i] + nodes[g], start, step, len(shape))
            w1, w2, w3, f1, f2, f3 = _inertial(shape[k], place[k], z, 2.0 / step)
            gyro[i, 0] += weights[g] * w1
            gyro[i, 1] += weights[g] * w2
            gyro[i, 2] += weights[g] * w3
            accel[i, 0] += weights[g] * f1
            accel[i, 1] += weights[g] * f2
            accel[i, 2] += weights[g] * f3


@kernel(allocates=True)
def first_order(x: Floats, a: float) -> None:
    """x[k] += a x[k-1], in place."""
    for k in range(1, len(x)):
        x[k] += a * x[k - 1]


@kernel(allocates=True)
def kinematics(
    shape: Floats, place: Floats, start: float, step: float, t: Floats, llh: Floats, vel_enu: Floats, q_enu_body: Floats
) -> None:
    """Write place, ENU velocity and attitude (xyzw) at times t (N,)."""
    for i in range(len(t)):
        k, z = _locate(t[i], start, step, len(shape))
        for axis in range(3):
            llh[i, axis] = _value(place[k, axis], z)
        v, yaw = _value(shape[k, 0], z), _value(shape[k, 1], z)
        grade, roll = _value(shape[k, 2], z), _value(shape[k, 3], z)
        vel_enu[i, 0] = v * math.cos(yaw) * math.cos(grade)
        vel_enu[i, 1] = v * math.sin(yaw) * math.cos(grade)
        vel_enu[i, 2] = v * math.sin(grade)
        sy, cy = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        sp, cp = math.sin(-0.5 * grade), math.cos(0.5 * grade)
        sr, cr = math.sin(0.5 * roll), math.cos(0.5 * roll)
        q_enu_body[i, 0] = sr * cp * cy - cr * sp * sy
        q_enu_body[i, 1] = cr * sp * cy + sr * cp * sy
        q_enu_body[i, 2] = cr * cp * sy - sr * sp * cy
        q_enu_body[i, 3] = cr * cp * cy + sr * sp * sy
