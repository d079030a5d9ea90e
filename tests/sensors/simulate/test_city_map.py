"""The made-up city: of a seed, as long as asked for, and its parts where they belong."""

import numpy as np

from sensors.maps.vector_map import Kind, VectorMap
from sensors.simulate.city_map import city_map
from sensors.simulate.furnishing import HALF_WIDTH_M, LANE_M


def columns(city: VectorMap) -> list[np.ndarray]:
    return [city.elements.xyz, city.elements.kind, city.surfels.p, city.surfels.normal]


def test_it_is_that_of_its_seed() -> None:
    first, again, other = (columns(city_map(2.0, seed)) for seed in (4, 4, 5))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[2][:100], other[2][:100])


def test_what_it_holds() -> None:
    city = city_map(5.0, 1)
    assert city.road_km is not None
    assert 4.0 < city.road_km < 6.0
    assert len(city.surfels) >= 10_000 * city.road_km
    elements = city.elements
    assert set(elements.kind) == set(Kind)
    assert len(set(elements.name)) == len(elements)
    steps = np.linalg.norm(np.diff(elements.vertices(0)[:, :2], axis=0), axis=1)
    assert 2.0 < steps.min() <= steps.max() < 3.2
    for row in np.flatnonzero(np.isin(elements.kind, (Kind.CROSSING, Kind.SIGN))):
        ring = elements.vertices(row)
        np.testing.assert_array_equal(ring[0], ring[-1])
    np.testing.assert_allclose(np.linalg.norm(city.surfels.normal, axis=1), 1.0, atol=1e-12)
    assert (city.surfels.normal[:, 2] >= 0.0).all()
    assert ((city.surfels.ratios > 0.0) & (city.surfels.ratios <= 0.1)).all()


def test_curbs_run_beside_the_lane_in_the_middle_of_the_street() -> None:
    elements = city_map(2.0, 1).elements
    lines = [elements.vertices(row) for row in np.flatnonzero(elements.kind <= Kind.ROAD_BOUNDARY)]
    streets = len(lines) // 5
    yellow, _, white, left, right = (lines[k * streets : (k + 1) * streets] for k in range(5))
    for line, curb, width in ((yellow, left, HALF_WIDTH_M - LANE_M / 2), (white, yellow, LANE_M), (left, right, 14.0)):
        for a, b in zip(line, curb, strict=True):
            np.testing.assert_allclose(np.linalg.norm((a - b)[:, :2], axis=1), width, atol=0.1)
