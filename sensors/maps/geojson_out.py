"""A map as GeoJSON, so that a GIS shows it: ``sensors.maps.geojson`` reads it back to 1 mm. Surfels stay behind."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats
from sensors.maps.geojson import Own
from sensors.maps.placing import LOCAL, geodetic
from sensors.maps.vector_map import Colour, Kind, Style, VectorMap
from sensors.whole_file import whole_file

DEGREE_DIGITS, HEIGHT_DIGITS = 9, 4
"""Decimals: 0.1 mm."""
_OUTLINES = frozenset({Kind.CROSSING, Kind.MARKING, Kind.SIGN})


def write_geojson(vector_map: VectorMap, path: Path) -> None:
    """Write a map's elements as features with kind, style, colour, name and source.

    Raises EgolocError for a map without georeference, and where the file cannot be written; it is then as it was.
    """
    if vector_map.frame == LOCAL:
        raise EgolocError(
            f"{path}: the map is a local plane without georeference: GeoJSON needs longitude and latitude"
        )
    own = msgspec.to_builtins(Own(vector_map.frame, vector_map.road_km))
    text = msgspec.json.encode({"type": "FeatureCollection", "egoloc": own, "features": _features(vector_map)})
    with whole_file(path) as partial:
        partial.write_bytes(text)


def _features(vector_map: VectorMap) -> list[dict[str, Any]]:
    elements = vector_map.elements
    llh = geodetic(vector_map.frame, elements.xyz)
    degrees = np.degrees(llh[:, [1, 0]]).round(DEGREE_DIGITS).tolist()
    heights = llh[:, 2].round(HEIGHT_DIGITS).tolist()
    positions = [at if np.isnan(h) else [*at, h] for at, h in zip(degrees, heights, strict=True)]
    columns = zip(elements.kind, elements.style, elements.colour, elements.source, elements.name, strict=True)
    features = []
    for row, (kind, style, colour, source, name) in enumerate(columns):
        chosen = slice(elements.first[row], elements.first[row + 1])
        properties = {
            "kind": Kind(kind).name.lower(),
            "style": Style(style).name.lower(),
            "colour": Colour(colour).name.lower(),
            "name": str(name),
            "source": vector_map.sources[source],
        }
        geometry = _geometry(Kind(kind), elements.xyz[chosen], positions[chosen])
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return features


def _geometry(kind: Kind, xyz: Floats, positions: list[list[float]]) -> dict[str, Any]:
    if len(positions) == 1:
        return {"type": "Point", "coordinates": positions[0]}
    if kind in _OUTLINES and len(positions) > 3 and positions[0] == positions[-1]:
        # RFC 7946: an outline runs counter-clockwise. A face's order stays: it says from where it is seen.
        turned = kind is not Kind.SIGN and _signed_area(xyz) < 0
        return {"type": "Polygon", "coordinates": [positions[::-1] if turned else positions]}
    return {"type": "LineString", "coordinates": positions}


def _signed_area(ring: Floats) -> float:
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
