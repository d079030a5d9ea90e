"""Control points corrected until the motion that they make keeps to given places: splines round off what they pass."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from sensors.geodesy import meridian_radius, transverse_radius
from sensors.simulate import _road_kernels
from sensors.simulate.trajectory import KNOT_S, Profile, Truth

Floats = NDArray[np.float64]


def offsets(llh: Floats, wanted: Floats) -> Floats:
    """(N, 3) m east, north and up from llh (N, 3) to wanted (N, 3) nearby."""
    lat, h = llh[:, 0], llh[:, 2]
    metres = np.stack(((transverse_radius(lat) + h) * np.cos(lat), meridian_radius(lat) + h, np.ones_like(h)), axis=-1)
    return (wanted - llh)[:, [1, 0, 2]] * metres


def steered(
    profile: Profile, truth: Truth, wanted: Floats, slack: tuple[float, float, float], smooth_s: float = 0.0
) -> Profile:
    """The profile of a truth, changed so that its knots (K + 1, 3) come nearer to wanted (K + 1, 3) llh.

    slack: shares of the speed by which it may change along, across and up; smooth_s: length of the mean of the offsets.
    """
    error = offsets(truth.knots, wanted)
    if smooth_s > 0:
        error = uniform_filter1d(error, round(smooth_s / KNOT_S) | 1, axis=0, mode="nearest")
    control = np.stack((profile.speed, profile.yaw, profile.grade, profile.roll), axis=-1)
    _road_kernels.steer(control, error, KNOT_S, np.array(slack))
    speed, yaw, grade, roll = control.T
    return replace(profile, speed=speed, yaw=yaw, grade=grade, roll=roll)
