"""Batches of none, one and many points keep their shape in every conversion."""

import numpy as np
import pytest

from sensors.geodesy import MapFrame, ecef_from_llh, llh_from_ecef, llh_from_map, map_from_llh, rotation_map_enu

FRAMES = [MapFrame("enu", (49.0, 8.4, 110.0)), MapFrame("utm", (4.5e5, 5.4e6, 0.0), 32)]


@pytest.mark.parametrize("n", [0, 1, 5])
@pytest.mark.parametrize("frame", FRAMES)
def test_round_trip(frame: MapFrame, n: int) -> None:
    llh = np.tile((np.radians(49.001), np.radians(8.402), 120.0), (n, 1))
    np.testing.assert_allclose(llh_from_map(frame, map_from_llh(frame, llh)), llh, atol=1e-8)
    np.testing.assert_allclose(llh_from_ecef(ecef_from_llh(llh)), llh, atol=1e-8)
    assert rotation_map_enu(frame, llh)[0].shape == (n, 3, 3)
