"""WGS-84 <-> ECEF <-> ENU <-> map frame, in batches. pymap3d does the ellipsoid, pyproj does UTM.

``llh`` is (N, 3) latitude rad, longitude rad, ellipsoidal height m. A map frame is UTM or one ENU plane, each with an
origin that keeps map coordinates small (float32 is 0.5 m coarse at UTM northings).
"""

from functools import lru_cache
from typing import Any, Literal

import msgspec
import numpy as np
import pymap3d
from numpy.typing import ArrayLike, NDArray
from pyproj import Proj

from sensors.errors import EgolocError
from sensors.grid import grid_rotations

Floats = NDArray[np.float64]


class MapFrame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a map's x, y, z lie on the earth.

    utm: x, y = easting, northing - origin[:2], z = ellipsoidal height - origin[2], axes along the grid.
    enu: the plane tangent at the datum ``origin`` = (latitude deg, longitude deg, height m).
    """

    kind: Literal["utm", "enu"]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """utm: easting m, northing m, height m to subtract; enu: latitude deg, longitude deg, height m of the datum."""
    zone: int = 0
    """UTM zone 1..60 (utm only)."""
    south: bool = False
    """UTM, southern hemisphere."""

    def __post_init__(self) -> None:
        if self.kind == "utm" and not 1 <= self.zone <= 60:
            raise EgolocError(f"map frame: zone: expected 1..60, got {self.zone}")
        if not np.isfinite(self.origin).all():
            raise EgolocError(f"map frame: origin: expected finite numbers, got {self.origin}")
        if self.kind == "enu" and not (abs(self.origin[0]) <= 90 and abs(self.origin[1]) <= 360):
            raise EgolocError(f"map frame: origin: expected latitude and longitude in degrees, got {self.origin}")


def utm_frame(llh: ArrayLike, zone: int = 0) -> MapFrame:
    """The UTM frame of the zone that holds a point (3,), its origin rounded down to whole kilometres.

    zone: another one than the point's, negative in the south; 0: the point's.
    """
    lat, lon, _ = np.asarray(llh, np.float64)
    if not abs(lat) <= np.radians(84.5):
        raise EgolocError(f"UTM: expected a latitude within 84 deg, got {np.degrees(lat):.3f}")
    own = int((np.degrees(lon) + 180.0) // 6.0) % 60 + 1
    whole = MapFrame("utm", zone=abs(zone) or own, south=bool(lat < 0 if zone == 0 else zone < 0))
    x, y, _ = map_from_llh(whole, np.atleast_2d(llh))[0]
    return MapFrame("utm", (float(x // 1000 * 1000), float(y // 1000 * 1000), 0.0), whole.zone, whole.south)


def ecef_from_llh(llh: ArrayLike) -> Floats:
    """(N, 3) earth-centred earth-fixed coordinates, m."""
    lat, lon, h = np.asarray(llh, np.float64).T
    return np.stack(pymap3d.geodetic2ecef(lat, lon, h, deg=False), axis=-1)


def llh_from_ecef(ecef: ArrayLike) -> Floats:
    """(N, 3) geodetic coordinates of (N, 3) ECEF, m."""
    x, y, z = np.asarray(ecef, np.float64).T
    return _rows(pymap3d.ecef2geodetic(x, y, z, deg=False))


def enu_from_llh(llh: ArrayLike, datum: ArrayLike) -> Floats:
    """(N, 3) coordinates in the plane tangent at datum (3,) llh, m."""
    lat, lon, h = np.asarray(llh, np.float64).T
    lat0, lon0, h0 = np.asarray(datum, np.float64)
    return np.stack(pymap3d.geodetic2enu(lat, lon, h, lat0, lon0, h0, deg=False), axis=-1)


def llh_from_enu(enu: ArrayLike, datum: ArrayLike) -> Floats:
    """(N, 3) geodetic coordinates of (N, 3) in the plane tangent at datum (3,) llh."""
    east, north, up = np.asarray(enu, np.float64).T
    lat0, lon0, h0 = np.asarray(datum, np.float64)
    return _rows(pymap3d.enu2geodetic(east, north, up, lat0, lon0, h0, deg=False))


def rotation_ecef_enu(llh: ArrayLike) -> Floats:
    """(N, 3, 3) R_ecef_enu at each point."""
    lat, lon, _ = np.asarray(llh, np.float64).T
    sf, cf, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(sf)
    rows = ((-sl, -sf * cl, cf * cl), (cl, -sf * sl, cf * sl), (zero, cf, sf))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def map_from_llh(frame: MapFrame, llh: ArrayLike) -> Floats:
    """(N, 3) map coordinates, m."""
    points = np.asarray(llh, np.float64)
    if frame.kind == "enu":
        return enu_from_llh(points, _datum(frame))
    x, y = _utm(frame.zone, frame.south)(points[:, 1], points[:, 0], radians=True)
    return np.stack((x, y, points[:, 2]), axis=-1) - frame.origin


def llh_from_map(frame: MapFrame, p_map: ArrayLike) -> Floats:
    """(N, 3) geodetic coordinates of (N, 3) map coordinates."""
    points = np.asarray(p_map, np.float64)
    if frame.kind == "enu":
        return llh_from_enu(points, _datum(frame))
    x, y, h = (points + frame.origin).T
    lon, lat = _utm(frame.zone, frame.south)(x, y, inverse=True, radians=True)
    return np.stack((lat, lon, h), axis=-1)


def rotation_map_enu(frame: MapFrame, llh: ArrayLike) -> tuple[Floats, Floats]:
    """(N, 3, 3) R_map_enu, the local ENU axes seen in map axes, and (N,) the map's scale there.

    utm: the meridian convergence and the point scale of the ellipsoid's surface (height excluded), ``sensors.grid``.
    enu: earth's curvature, scale 1.
    """
    points = np.ascontiguousarray(llh, np.float64)
    if frame.kind == "enu":
        to_datum = rotation_ecef_enu(np.array([_datum(frame)]))[0].T
        return to_datum @ rotation_ecef_enu(points), np.ones(len(points))
    rotation, scale = np.empty((len(points), 3, 3)), np.empty(len(points))
    grid_rotations(points, np.radians(6.0 * frame.zone - 183.0), rotation, scale)
    return rotation, scale


def meridian_radius(lat: ArrayLike) -> Floats:
    """(N,) radius of curvature of the meridian, m."""
    result: Floats = np.asarray(pymap3d.rcurve.meridian(np.asarray(lat, np.float64), deg=False))
    return result


def transverse_radius(lat: ArrayLike) -> Floats:
    """(N,) radius of curvature of the prime vertical, m."""
    result: Floats = np.asarray(pymap3d.rcurve.transverse(np.asarray(lat, np.float64), deg=False))
    return result


def _rows(columns: tuple[Any, Any, Any]) -> Floats:
    """(N, 3) of three columns; of a single point pymap3d gives the latitude without its axis."""
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


def _datum(frame: MapFrame) -> tuple[float, float, float]:
    lat, lon, h = frame.origin
    return float(np.radians(lat)), float(np.radians(lon)), h


@lru_cache(maxsize=8)
def _utm(zone: int, south: bool) -> Any:
    return Proj(proj="utm", zone=zone, south=south, ellps="WGS84")
