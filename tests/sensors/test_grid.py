"""The grid's turn and scale agree with pyproj's, anywhere in a zone and across the date line."""

import numpy as np
import pytest
from pyproj import Proj

from sensors.geodesy import MapFrame, rotation_map_enu


@pytest.mark.parametrize(("zone", "south"), [(32, False), (1, False), (60, True), (19, True)])
def test_turn_and_scale_are_those_of_pyproj(zone: int, south: bool) -> None:
    rng = np.random.default_rng(zone)
    lat = np.radians(rng.uniform(-84.0, 84.0, 200))
    meridian = np.radians(6 * zone - 183)
    lon = meridian + np.radians(rng.uniform(-5.0, 5.0, 200))
    rotation, scale = rotation_map_enu(MapFrame("utm", zone=zone, south=south), np.column_stack((lat, lon, 0 * lat)))
    factors = Proj(proj="utm", zone=zone, south=south, ellps="WGS84").get_factors(lon, lat, radians=True)
    turn = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    np.testing.assert_allclose(turn, np.radians(factors.meridian_convergence), atol=1e-9)
    np.testing.assert_allclose(scale, factors.meridional_scale, atol=1e-9)
    assert np.ptp(turn) > 0.1


def test_the_turn_is_where_the_grid_says_north_is() -> None:
    lat, lon, step = np.radians(52.0), np.radians(11.5), 1e-5
    utm = Proj(proj="utm", zone=32, ellps="WGS84")
    x, y = (np.diff(ends)[0] for ends in utm((lon, lon), (lat - step, lat + step), radians=True))
    rotation, _ = rotation_map_enu(MapFrame("utm", zone=32), np.array([[lat, lon, 0.0]]))
    north = rotation[0] @ [0.0, 1.0, 0.0]
    assert np.arctan2(north[0], north[1]) == pytest.approx(np.arctan2(x, y), abs=1e-8)


def test_the_other_side_of_the_date_line_is_near() -> None:
    place = np.radians([[10.0, 179.0, 0.0], [10.0, -181.0, 0.0]])
    rotation, scale = rotation_map_enu(MapFrame("utm", zone=60), place)
    np.testing.assert_allclose(rotation[0], rotation[1], atol=1e-12)
    assert scale[0] == pytest.approx(scale[1], abs=1e-12)
