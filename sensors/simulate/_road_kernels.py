"""Kernels of roads and of driving on them. Arrays in and out, no config."""

import math

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@kernel()
def sum_of_waves(amplitude: Floats, number: Floats, phase: Floats, xy: Floats, values: Floats) -> None:
    """Write the sum over waves (W,) of amplitude cos(number . xy + phase) at places xy (N, 2)."""
    for i in range(len(xy)):
        total = 0.0
        for w in range(len(phase)):
            total += amplitude[w] * math.cos(number[w, 0] * xy[i, 0] + number[w, 1] * xy[i, 1] + phase[w])
        values[i] = total


@kernel()
def plan_speed(
    step: float,
    edges: Floats,
    curvature: Floats,
    speed_limit: Floats,
    stops: Ints,
    rests: Floats,
    limits: Floats,
    speed: Floats,
    leaves: Floats,
) -> None:
    """Write the speed at every step (R,) of a route and when it is left; limits: forward, braking, lateral, m/s^2.

    The square of the speed grows by at most 2 a per metre ahead of any lower limit and 2 b per metre behind one.
    """
    count, element, stop = len(speed), 0, 0
    ahead, behind, lateral = 2 * limits[0], 2 * limits[1], limits[2]
    least = math.inf
    for k in range(count):
        s = k * step
        while element < len(curvature) - 1 and edges[element + 1] <= s:
            element += 1
        squared = min(speed_limit[element] ** 2, lateral / max(abs(curvature[element]), 1e-9))
        if stop < len(stops) and stops[stop] == k:
            squared = 0.0
            stop += 1
        least = min(least, squared - ahead * s)
        speed[k] = least + ahead * s
    least = math.inf
    for k in range(count - 1, -1, -1):
        s = k * step
        least = min(least, speed[k] + behind * s)
        speed[k] = math.sqrt(max(least - behind * s, 0.0))
    passed, stop = 0.0, 1
    leaves[0] = rests[0]
    for k in range(1, count):
        wait = 0.0
        if stop < len(stops) and stops[stop] == k:
            wait = rests[stop]
            stop += 1
            speed[k] = 0.0
        both = speed[k] + speed[k - 1]
        # from one stop to another a step ahead: at a crawl
        passed += 2 * step / (both if both > 0.0 else 0.5) + wait
        leaves[k] = passed + rests[0]
    speed[0] = 0.0


@kernel()
def ride(
    step: float, speed: Floats, leaves: Floats, stops: Ints, rests: Floats, t: Floats, s: Floats, v: Floats
) -> None:
    """Write place and speed at increasing times t (N,) of a drive by plan_speed's result."""
    row, stop, last = -1, 0, len(speed) - 1
    for i in range(len(t)):
        while row < last and leaves[row + 1] <= t[i]:
            row += 1
        while stop < len(stops) and stops[stop] <= row:
            stop += 1
        if row == last:
            s[i], v[i] = row * step, speed[row]
            continue
        arrives = leaves[row + 1]
        if stop < len(stops) and stops[stop] == row + 1:
            arrives -= rests[stop]
        if row < 0 or t[i] >= arrives:
            s[i], v[i] = (row + 1) * step, 0.0
            continue
        slope = (speed[row + 1] - speed[row]) / max(arrives - leaves[row], 1e-12)
        into = t[i] - leaves[row]
        v[i] = slope * into + speed[row]
        s[i] = row * step + speed[row] * into + 0.5 * slope * into * into


@kernel()
def steer(control: Floats, error: Floats, step: float, slack: Floats) -> None:
    """Change control points (K + 5, 4) of speed, yaw, grade and roll, in place, so that places gain error (K + 1, 3).

    error: ENU m at the knots, of what is wanted against what is; slack: (3,) of the speed that may be changed along,
    across and up at a time: what does not fit comes later. Control points at rest stay at rest.
    """
    east, north, up = error[0, 0], error[0, 1], error[0, 2]
    last = len(error) - 1
    for j in range(len(control)):
        k = min(max(j - 2, 0), last)
        before, after = max(k - 1, 0), min(k + 1, last)
        if j > 1:
            east += 0.5 * (error[after, 0] - error[before, 0])
            north += 0.5 * (error[after, 1] - error[before, 1])
            up += 0.5 * (error[after, 2] - error[before, 2])
        speed, yaw, grade = control[j, 0], control[j, 1], control[j, 2]
        if speed == 0.0:
            continue
        way = -1.0 if speed < 0.0 else 1.0
        sy, cy, level = way * math.sin(yaw), way * math.cos(yaw), abs(speed) * math.cos(grade) * step
        along, left = cy * east + sy * north, cy * north - sy * east
        along = min(max(along, -slack[0] * level), slack[0] * level)
        left = min(max(left, -slack[1] * level), slack[1] * level)
        climb = min(max(up, -slack[2] * level), slack[2] * level)
        east -= cy * along - sy * left
        north -= sy * along + cy * left
        up -= climb
        forward, climb = level + along, climb + speed * math.sin(grade) * step
        flat = math.hypot(forward, left)
        control[j, 0] = way * math.hypot(flat, climb) / step
        control[j, 1] = yaw + math.atan2(left, forward)
        control[j, 2] = math.atan2(way * climb, flat)
