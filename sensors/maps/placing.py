"""Where a source's coordinates come to lie in a map: geodetic ones in a frame asked for or of the place, local ones."""

import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats, MapFrame, llh_from_map, map_from_llh, utm_frame

LOCAL = MapFrame("enu")
"""The plane of a source without georeference. Its datum, 0, 0, says nothing."""
MAX_FROM_MERIDIAN_DEG = 3.5
"""A UTM zone reaches 3 deg from its central meridian; maps overlap into the next one by half a degree."""
MAX_FROM_DATUM_M = 100e3
"""A tangent plane: at this distance the earth has fallen away by 780 m."""

MAX_M = 1e7
"""Of local coordinates and heights: from the equator to a pole."""
PASSES = 3
"""Towards the height of a point of a plane: each makes the rest smaller by the square of its slope."""


def placed(where: str, llh: Floats, frame: MapFrame | None, zone: int = 0) -> tuple[MapFrame, Floats]:
    """A frame and (N, 3) coordinates in it of (N, 3) rad, rad, m; heights may be NaN and stay so.

    where: the file, for messages. frame None: the UTM frame of the points' middle, in the zone that the file is
    written in, negative in the south, if it reaches so far. Raises EgolocError for points off the earth, and for a
    frame that is another place's.
    """
    if not len(llh):
        return frame or LOCAL, np.empty((0, 3))
    off_earth = ~((np.abs(llh[:, 0]) <= np.pi / 2) & (np.abs(llh[:, 1]) <= 2 * np.pi))
    if off_earth.any():
        lat, lon, _ = np.degrees(llh[np.argmax(off_earth)])
        raise EgolocError(f"{where}: expected latitude and longitude in degrees, got {lat:.7g}, {lon:.7g}")
    refuse_far(where, llh[:, 2:])
    if frame is None:
        frame = _own_frame(where, llh, zone)
    _refuse_other_zone(where, llh, frame)
    xyz = map_from_llh(frame, np.column_stack((llh[:, :2], _heights(llh[:, 2], frame))))
    xyz[np.isnan(llh[:, 2]), 2] = np.nan
    distance = np.hypot(*xyz[:, :2].T).max()
    if frame.kind == "enu" and distance > MAX_FROM_DATUM_M:
        raise EgolocError(f"{where}: the map asked for is another place's: {distance / 1e3:.0f} km from its datum")
    return frame, xyz


def _own_frame(where: str, llh: Floats, zone: int) -> MapFrame:
    """The UTM frame of the points' middle."""
    middle = np.array([*np.median(llh[:, :2], axis=0), 0.0])
    if np.abs(llh[:, 1] - middle[1]).max() > np.radians(MAX_FROM_MERIDIAN_DEG):
        wide = np.degrees(np.ptp(llh[:, 1]))
        raise EgolocError(
            f"{where}: expected a map within one UTM zone, got one that is {wide:.1f} deg of longitude wide"
        )
    try:
        return utm_frame(middle, zone if _in_zone(llh, abs(zone), zone < 0) else 0)
    except EgolocError as error:
        raise EgolocError(f"{where}: {error}") from error


def refuse_far(where: str, metres: Floats) -> None:
    """Refuse local coordinates or heights that are no metres of a place on the earth; NaN is let through."""
    if np.abs(metres, where=np.isfinite(metres), out=np.zeros_like(metres)).max(initial=0.0) > MAX_M:
        worst = metres.ravel()[np.nanargmax(np.abs(metres))]
        raise EgolocError(f"{where}: expected metres within {MAX_M:.0e}, got {worst:.4g}")


def refuse_frame(where: str, frame: MapFrame | None) -> None:
    """Refuse to bring local coordinates into a frame on the earth; files of one plane may be brought together."""
    if frame not in (None, LOCAL):
        raise EgolocError(
            f"{where}: has only local coordinates, without georeference: cannot be brought into a map frame"
        )


def _refuse_other_zone(where: str, llh: Floats, frame: MapFrame) -> None:
    if frame.kind == "utm" and not _in_zone(llh, frame.zone, frame.south):
        own = utm_frame(llh[np.argmax(_from_meridian_deg(llh, frame.zone))] * (1.0, 1.0, 0.0))
        lies, asked = (f"{f.zone}{'S' if f.south else 'N'}" for f in (own, frame))
        raise EgolocError(f"{where}: lies in UTM zone {lies}, the map asked for is in zone {asked}")


def _in_zone(llh: Floats, zone: int, south: bool) -> bool:
    """Whether a zone reaches all points, with its overlap; they may cross the equator."""
    return bool(_from_meridian_deg(llh, zone).max() <= MAX_FROM_MERIDIAN_DEG and (np.median(llh[:, 0]) < 0) == south)


def _from_meridian_deg(llh: Floats, zone: int) -> Floats:
    away: Floats = np.abs((np.degrees(llh[:, 1]) - (6.0 * zone - 183.0) + 180.0) % 360.0 - 180.0)
    return away


def geodetic(frame: MapFrame, xyz: Floats) -> Floats:
    """(N, 3) rad, rad, m of (N, 3) map coordinates: the way back of ``placed``, with heights that may be NaN."""
    known = np.isfinite(xyz[:, 2])
    filled = np.where(known, xyz[:, 2], 0.0)
    llh = llh_from_map(frame, np.column_stack((xyz[:, :2], filled)))
    for _ in range(PASSES):  # a plane's z at the datum's height depends on the place, and the place a little on z
        filled = np.where(known, filled, filled - (llh[:, 2] - frame.origin[2]))
        llh = llh_from_map(frame, np.column_stack((xyz[:, :2], filled)))
    llh[~known, 2] = np.nan
    return llh


def _heights(heights: Floats, frame: MapFrame) -> Floats:
    """Heights with the datum's where not known: a plane's x and y need one, and 1 m of it is 0.2 mm at 1 km."""
    return np.where(np.isnan(heights), frame.origin[2], heights)
