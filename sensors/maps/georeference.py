"""A map file's own projection, a PROJ string or WKT. ``sensors.maps.placing`` brings what it gives into a map's frame.

Heights pass through: a geoid named in the projection is not applied, and the importer says so.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from sensors.errors import EgolocError
from sensors.maps.vector_map import Floats

VERTICAL = ("+geoidgrids", "+vunits", "+vto_meter")


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
