"""The map at a place as the linear map that it is there: one pass over the fixes, as live use has one at a time."""

import math

from fusion.state import Floats
from sensors.kernel import kernel


@kernel()
def linearize(rotation: Floats, scale: Floats, yaw: Floats, to_enu: Floats, tilt: Floats, yaw_enu: Floats) -> None:
    """From R_map_enu (N, 3, 3), the map's scale (N,) and yaws (N,) in the map: what they are in ENU.

    to_enu (N, 3, 3): map (x, y, yaw) errors to (east, north, yaw); tilt (N, 2): what a metre of height moves a point
    of the map horizontally; yaw_enu (N,): from east.
    """
    for n in range(len(scale)):
        k = scale[n]
        xe, xn, xu = k * rotation[n, 0, 0], k * rotation[n, 0, 1], k * rotation[n, 0, 2]
        ye, yn, yu = k * rotation[n, 1, 0], k * rotation[n, 1, 1], k * rotation[n, 1, 2]
        determinant = xe * yn - xn * ye
        ex, ey = yn / determinant, -xn / determinant
        nx, ny = -ye / determinant, xe / determinant
        to_enu[n, 0, 0], to_enu[n, 0, 1], to_enu[n, 0, 2] = ex, ey, 0.0
        to_enu[n, 1, 0], to_enu[n, 1, 1], to_enu[n, 1, 2] = nx, ny, 0.0
        to_enu[n, 2, 0], to_enu[n, 2, 1], to_enu[n, 2, 2] = 0.0, 0.0, 1.0
        tilt[n, 0], tilt[n, 1] = ex * xu + ey * yu, nx * xu + ny * yu
        c, s = math.cos(yaw[n]), math.sin(yaw[n])
        yaw_enu[n] = math.atan2(nx * c + ny * s, ex * c + ey * s)
