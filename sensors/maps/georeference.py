"""From a map file's own projection, a PROJ string or WKT, to the map's frame.

Heights pass through: a geoid named in the projection is not applied, and the importer says so.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, map_from_llh, utm_frame
from sensors.maps.vector_map import Floats

VERTICAL = ("+geoidgrids", "+vunits", "+vto_meter")
FAR_M = 500e3
"""A plane tangent at a datum is no map at this distance from it; a UTM zone ends before."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """A projection. zone: that of the file if it is a UTM one, negative in the south, 0 where it is another."""

    path: Path
    to_degrees: Transformer
    zone: int
    geoid: bool

    def llh(self, xyz: Floats) -> Floats:
        """(N, 3) rad, rad, m of coordinates (N, 3) in the projection. Raises EgolocError outside of it."""
        lon, lat = self.to_degrees.transform(xyz[:, 0], xyz[:, 1])
        llh = np.column_stack((np.radians(lat), np.radians(lon), xyz[:, 2]))
        if not np.isfinite(llh[:, :2]).all():
            raise EgolocError(f"{self.path}: expected coordinates within its projection, got some off the earth")
        return llh


def georeference(text: str, path: Path) -> Georeference:
    """Read a projection. Raises EgolocError where it is none, or one in degrees."""
    kept = " ".join(word for word in text.split() if not word.startswith(VERTICAL)) if "+proj" in text else text
    try:
        crs = CRS.from_user_input(kept)
    except CRSError as error:
        raise EgolocError(f"{path}: georeference: expected a PROJ string or WKT, got {text[:60]!r}") from error
    if not crs.is_projected:
        raise EgolocError(f"{path}: georeference: expected a projection in metres, got {text[:60]!r}")
    zone = crs.utm_zone
    signed = int(zone[:-1]) * (-1 if zone[-1] == "S" else 1) if zone else 0
    transformer = Transformer.from_crs(crs.to_2d(), CRS.from_epsg(4326), always_xy=True)
    return Georeference(path, transformer, signed, "geoidgrids" in text)


def placed(
    reference: Georeference | None, xyz: Floats, frame: MapFrame | None, path: Path
) -> tuple[MapFrame, Callable[[Floats], Floats]]:
    """The map's frame, and what brings the file's coordinates (N, 3) into it.

    xyz: (N, 3) the file's coordinates. frame None: the file's own UTM zone, else that of its middle; without a
    georeference a local plane whose datum is not known (0, 0). Raises EgolocError where the file cannot be brought
    into frame.
    """
    if reference is None:
        if frame is not None:
            raise EgolocError(f"{path}: has no georeference, so it cannot be brought into a {frame.kind} frame")
        return MapFrame("enu"), lambda points: points
    middle = reference.llh(0.5 * (xyz.min(axis=0) + xyz.max(axis=0))[None]) if len(xyz) else np.zeros((1, 3))
    own = _own_frame(reference, middle)
    target = frame or own
    if target.kind == "utm" and target.zone != own.zone:
        raise EgolocError(f"{path}: expected a map in UTM zone {target.zone}, got one in zone {own.zone}")
    off = np.linalg.norm(map_from_llh(target, middle)[0, :2])
    if target.kind == "enu" and len(xyz) and off > FAR_M:
        raise EgolocError(f"{path}: expected a map within {FAR_M / 1e3:.0f} km of the datum, got {off / 1e3:.0f} km")
    return target, lambda points: map_from_llh(target, reference.llh(points))


def _own_frame(reference: Georeference, middle: Floats) -> MapFrame:
    """UTM, its origin on whole kilometres near the middle (1, 3) llh."""
    if not reference.zone:
        return utm_frame(middle[0])
    frame = MapFrame("utm", zone=abs(reference.zone), south=reference.zone < 0)
    x, y, _ = map_from_llh(frame, middle)[0]
    return msgspec.structs.replace(frame, origin=(float(x // 1000 * 1000), float(y // 1000 * 1000), 0.0))
