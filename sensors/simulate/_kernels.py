"""Kernels of the simulated truth: piecewise polynomials over spline knots. Arrays in and out, no config.

Tables: shape (K, 4, 6) speed, yaw, grade, roll; place (K, 3, D) latitude, longitude, height; row k is the interval
[start + k step, start + (k + 1) step], its polynomials ascending in z in [-1, 1].
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors._kernels import EARTH_RATE, WGS84_E2, gravity_enu, radii
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


@kernel()
def spline_pieces(control: Floats, spline: Floats, shape: Floats) -> None:
    """Write the shape table (K, 4, 6) of quintic B-splines with control points (K + 5, 4); spline: (6, 6) powers."""
    for k in range(len(shape)):
        for column in range(4):
            # around a nearby control point, so that a constant has exactly zero slope
            near = control[k + 2, column]
            for d in range(6):
                power = 0.0
                for j in range(6):
                    power += (control[k + j, column] - near) * spline[j, d]
                shape[k, column, d] = power
            shape[k, column, 0] += near


@kernel(allocates=True)
def integrate_place(
    shape: Floats,
    knots: Floats,
    step: float,
    nodes: Floats,
    weights: Floats,
    at_nodes: Floats,
    powers: Floats,
    place: Floats,
) -> None:
    """Write the place table: lat' = vn/(RM+h), lon' = ve/((RN+h) cos lat), h' = vu by Gauss collocation on intervals.

    knots: (K + 1, 3) llh, the first given, the others written; at_nodes: (S, S) integrals from -1 to each node;
    powers: (S + 1, S) the same integrals as polynomials in z; place: (K, 3, S + 1), empty where only knots are asked.
    """
    stages = len(nodes)
    north, east, up = np.empty(stages), np.empty(stages), np.empty(stages)
    lat_rate, lon_rate, climb, change = np.empty(stages), np.empty(stages), np.empty(stages), np.empty(stages)
    lat, lon, h = knots[0, 0], knots[0, 1], knots[0, 2]
    half = 0.5 * step
    for k in range(len(shape)):
        per_north, per_north_lat, per_north_h, per_east, tangent, per_east_lat2, per_east_h = _per_metre(lat, h)
        for g in range(stages):
            v = _value(shape[k, 0], nodes[g]) * half
            yaw = _value(shape[k, 1], nodes[g])
            grade = _value(shape[k, 2], nodes[g])
            level = v * math.cos(grade)
            north[g], east[g], up[g] = level * math.sin(yaw), level * math.cos(yaw), v * math.sin(grade)
        for g in range(stages):
            climb[g] = 0.0
            for j in range(stages):
                climb[g] += at_nodes[g, j] * up[j]
            lat_rate[g] = north[g] * (per_north + per_north_h * climb[g])
        for g in range(stages):
            moved = 0.0
            for j in range(stages):
                moved += at_nodes[g, j] * lat_rate[j]
            lon_rate[g] = east[g] * (
                per_east * (1.0 + moved * (tangent + moved * per_east_lat2)) + per_east_h * climb[g]
            )
            # the radius hardly changes with latitude: one round leaves 1e-15 of the way
            change[g] = north[g] * per_north_lat * moved
        for g in range(stages):
            lat_rate[g] += change[g]
        if len(place):
            for d in range(stages + 1):
                a, b, c = 0.0, 0.0, 0.0
                for j in range(stages):
                    a += powers[d, j] * lat_rate[j]
                    b += powers[d, j] * lon_rate[j]
                    c += powers[d, j] * up[j]
                place[k, 0, d], place[k, 1, d], place[k, 2, d] = a, b, c
            place[k, 0, 0] += lat
            place[k, 1, 0] += lon
            place[k, 2, 0] += h
        for j in range(stages):
            lat += weights[j] * lat_rate[j]
            lon += weights[j] * lon_rate[j]
            h += weights[j] * up[j]
        knots[k + 1, 0], knots[k + 1, 1], knots[k + 1, 2] = lat, lon, h


@kernel(inline="always")
def _per_metre(lat: float, h: float) -> tuple[float, float, float, float, float, float, float]:
    """Series around a place of what a metre is worth: over an interval what is left out is 1e-13 of the way.

    Latitude by metre north, its slopes by latitude and by height; longitude by metre east, its linear and quadratic
    growth with latitude as a share of it, its slope by height.
    """
    sl, cl = math.sin(lat), math.cos(lat)
    meridian, transverse = radii(sl)
    per_north, tangent = 1.0 / (meridian + h), sl / cl
    w2 = 1.0 - WGS84_E2 * sl * sl
    bulge = WGS84_E2 * sl * cl / w2
    per_radius = 1.0 / (transverse + h)
    per_east = per_radius / cl
    by_lat = tangent - transverse * bulge * per_radius
    return (
        per_north,
        -3.0 * meridian * bulge * per_north * per_north,
        -per_north * per_north,
        per_east,
        by_lat,
        0.5 + tangent * tangent,
        -per_radius * per_east,
    )


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


@kernel(allocates=True)
def speeds(shape: Floats, start: float, step: float, t: Floats, speed: Floats) -> None:
    """Write the speed along the vehicle's axis at times t (N,)."""
    for i in range(len(t)):
        k, z = _locate(t[i], start, step, len(shape))
        speed[i] = _value(shape[k, 0], z)
