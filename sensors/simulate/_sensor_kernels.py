"""Kernels of the simulated sensors. Arrays in and out, no config."""

import math

import numpy as np
from numpy.typing import NDArray

from sensors._kernels import EARTH_RATE, radii
from sensors.kernel import kernel

Floats = NDArray[np.float64]


@kernel()
def first_order(x: Floats, a: float, last: Floats) -> None:
    """White rows x (N, C) become Gauss-Markov ones, in place; last (C,): the row before them, NaN: there is none."""
    fresh = math.sqrt(1.0 - a * a)
    for c in range(x.shape[1]):
        if math.isnan(last[c]):
            last[c] = x[0, c]
        else:
            last[c] = x[0, c] = a * last[c] + fresh * x[0, c]
    for k in range(1, len(x)):
        for c in range(x.shape[1]):
            last[c] = x[k, c] = a * last[c] + fresh * x[k, c]


@kernel()
def add_inertial_errors(
    samples: Floats,
    biases: Floats,
    at: Floats,
    bias_nodes: Floats,
    gain_nodes: Floats,
    axes: Floats,
    rest: float,
    sigma: float,
    white: Floats,
) -> None:
    """Errors of one triad, in place: samples (N, 3) become gain (axes samples) + bias + sigma white (N, 3).

    at: (N,) place between the nodes; bias_nodes, gain_nodes: (K, 3), interpolated; biases: (N, 3), written: what
    a sample is off at rest on level ground, where the third axis sees `rest`.
    """
    last = len(bias_nodes) - 2
    for i in range(len(samples)):
        k = min(int(at[i]), last)
        share = at[i] - k
        x, y, z = samples[i, 0], samples[i, 1], samples[i, 2]
        for c in range(3):
            bias = bias_nodes[k, c] + share * (bias_nodes[k + 1, c] - bias_nodes[k, c])
            gain = gain_nodes[k, c] + share * (gain_nodes[k + 1, c] - gain_nodes[k, c])
            biases[i, c] = bias + rest * (gain * axes[c, 2] - (1.0 if c == 2 else 0.0))
            samples[i, c] = gain * (axes[c, 0] * x + axes[c, 1] * y + axes[c, 2] * z) + bias + sigma * white[i, c]


@kernel()
def add_vibration(
    samples: Floats,
    level: Floats,
    line: Floats,
    turns: Floats,
    phase: Floats,
    shaking: Floats,
    last: Floats,
) -> None:
    """Vibration of one triad, in place: differences of white noise (nothing at zero frequency) and a line.

    level, line: (N,) root mean square of both; turns: (N,) of the wheel; phase: (3, 2) cosine and sine of each axis;
    shaking: (N, 3) white; last: (3,) the row before, updated.
    """
    half, root = math.sqrt(0.5), math.sqrt(2.0)
    for i in range(len(samples)):
        angle = 2.0 * math.pi * (turns[i] - math.floor(turns[i]))
        sine, cosine = root * line[i] * math.sin(angle), root * line[i] * math.cos(angle)
        for c in range(3):
            w = shaking[i, c]
            samples[i, c] += half * level[i] * (w - last[c]) + sine * phase[c, 0] + cosine * phase[c, 1]
            last[c] = w


@kernel()
def move_to_point(
    llh: Floats, vel_enu: Floats, q: Floats, rate: Floats, arm: Floats, error_enu: Floats, velocity_error: Floats
) -> None:
    """llh and vel_enu (N, 3) of the body become those of a point of it with errors, in place.

    q: (N, 4) q_enu_body; rate: (N, 3) rad/s of the body against inertial space, body axes; arm: (3,) m, body axes;
    error_enu: (N, 3) m; velocity_error: (N, 3) m/s. To second order in the displacement over the earth's radius.
    """
    for i in range(len(llh)):
        x, y, z, w = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        sl, cl = math.sin(llh[i, 0]), math.cos(llh[i, 0])
        # rows of R_enu_body
        e0, e1, e2 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        n0, n1, n2 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        u0, u1, u2 = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        # rate against the earth, crossed with the arm
        earth_n, earth_u = EARTH_RATE * cl, EARTH_RATE * sl
        r0 = rate[i, 0] - n0 * earth_n - u0 * earth_u
        r1 = rate[i, 1] - n1 * earth_n - u1 * earth_u
        r2 = rate[i, 2] - n2 * earth_n - u2 * earth_u
        c0, c1, c2 = r1 * arm[2] - r2 * arm[1], r2 * arm[0] - r0 * arm[2], r0 * arm[1] - r1 * arm[0]
        vel_enu[i, 0] += e0 * c0 + e1 * c1 + e2 * c2 + velocity_error[i, 0]
        vel_enu[i, 1] += n0 * c0 + n1 * c1 + n2 * c2 + velocity_error[i, 1]
        vel_enu[i, 2] += u0 * c0 + u1 * c1 + u2 * c2 + velocity_error[i, 2]
        east = e0 * arm[0] + e1 * arm[1] + e2 * arm[2] + error_enu[i, 0]
        north = n0 * arm[0] + n1 * arm[1] + n2 * arm[2] + error_enu[i, 1]
        up = u0 * arm[0] + u1 * arm[1] + u2 * arm[2] + error_enu[i, 2]
        _displace(llh, i, sl, cl, east, north, up)


@kernel(inline="always")
def _displace(llh: Floats, i: int, sl: float, cl: float, east: float, north: float, up: float) -> None:
    """Move row i by a vector of its ENU axes, m."""
    meridian, transverse = radii(sl)
    a, b = meridian + llh[i, 2], transverse + llh[i, 2]
    tangent = sl / cl
    llh[i, 0] += (north * (1.0 - up / a) - 0.5 * tangent * east * east / b) / a
    llh[i, 1] += east * (1.0 - up / b + tangent * north / b) / (b * cl)
    llh[i, 2] += up + 0.5 * (east * east / b + north * north / a)
