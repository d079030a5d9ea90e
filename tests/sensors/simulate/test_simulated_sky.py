"""What the sky does to GNSS: tunnels, canyons, wrong fixes, and covariances that do not know."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.geodesy import ecef_from_llh, rotation_ecef_enu
from sensors.records import GnssFix, GnssStatus, GnssVelocity
from sensors.simulate.environment import Environment, Sky
from sensors.simulate.gnss import GnssSensor
from sensors.simulate.gnss_config import GnssSimulation
from sensors.simulate.rtk import RtkHistory, Solution
from sensors.vehicle import Vehicle
from tests.sensors.simulate.courses import cruise, epochs, straight

CALM = GnssSimulation(float_per_hour=0.0, lost_per_hour=0.0)
HOURS = 50.0


def history(config: GnssSimulation, sky: Sky, seed: int = 0) -> Solution:
    """What the receiver has at 10 Hz over HOURS under one sky."""
    course = straight(HOURS * 3600, 10.0, (HOURS * 36_000, "here", Environment(sky=sky)))
    return RtkHistory(course, config, np.random.default_rng(seed)).at(epochs(HOURS * 3600, 10.0))


def lengths(now: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Seconds of each stretch of True at 10 Hz."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], now, [0])).astype(int)))
    return np.diff(edges)[::2] * 0.1


def test_a_tunnel_silences_the_receiver_and_it_comes_back_in_float() -> None:
    tunnel = Environment(sky=Sky(blocked=True))
    course = straight(
        300.0, 10.0, (1000.0, "city", Environment()), (1400.0, "tunnel", tunnel), (3000.0, "city", Environment())
    )
    t_ns = epochs(300.0, 10.0)
    status, offset, _ = RtkHistory(course, CALM, np.random.default_rng(0)).at(t_ns)
    s = course.place(t_ns)
    np.testing.assert_array_equal(status == GnssStatus.NONE, (s >= 1000.0) & (s < 1400.0))
    assert status[np.searchsorted(s, 1400.0)] == GnssStatus.FLOAT
    assert (status[s < 1000.0] == GnssStatus.FIXED).all()
    assert status[-1] == GnssStatus.FIXED
    assert not offset.any()


def test_reflections_come_where_the_sky_says_in_float_and_as_far() -> None:
    status, offset, doppler = history(CALM, Sky(multipath_per_hour=60.0, multipath_m=10.0))
    reflected = offset.any(axis=1)
    assert (status[reflected] == GnssStatus.FLOAT).all()
    np.testing.assert_array_equal(doppler.any(axis=1), reflected)
    found = lengths(reflected)
    assert len(found) / HOURS == pytest.approx(60.0, rel=0.15)
    # episodes that overlap count as one here
    assert found.mean() == pytest.approx(4.0, rel=0.15)
    jumps = np.unique(offset[reflected], axis=0)
    distance = np.hypot(jumps[:, 0], jumps[:, 1])
    assert distance.mean() == pytest.approx(10.0, rel=0.05)
    assert distance.std() == pytest.approx(10.0 / np.sqrt(2.0), rel=0.08)
    assert abs(jumps[:, :2].mean()) < 0.5


def test_after_a_reflection_the_solution_is_fixed_again_from_float() -> None:
    status, offset, _ = history(CALM, Sky(multipath_per_hour=20.0, multipath_m=10.0))
    reflected = offset.any(axis=1)
    after = np.flatnonzero(reflected[:-1] & ~reflected[1:]) + 1
    assert np.mean(status[after] == GnssStatus.FLOAT) > 0.95
    assert lengths((status == GnssStatus.FLOAT) & ~reflected).mean() == pytest.approx(4.0, rel=0.15)
    assert (status == GnssStatus.NONE).sum() == 0


def test_a_wrong_fix_says_fixed_for_tens_of_seconds() -> None:
    status, offset, _ = history(CALM, Sky(wrong_fix_per_hour=10.0))
    wrong = offset.any(axis=1)
    assert (status == GnssStatus.FIXED).all()
    assert len(lengths(wrong)) / HOURS == pytest.approx(10.0, rel=0.15)
    assert lengths(wrong).mean() == pytest.approx(30.0, rel=0.15)
    each = np.unique(offset[wrong], axis=0)
    assert each[:, :2].std() == pytest.approx(1.5, rel=0.1)


def test_a_wrong_fix_ends_with_the_next_float_or_loss_and_does_not_come_back() -> None:
    config = msgspec.structs.replace(CALM, wrong_fix_per_hour=30.0, wrong_fix_s=60.0, float_per_hour=60.0)
    status, offset, _ = history(config, Sky())
    assert not offset[status != GnssStatus.FIXED].any()
    wrong = offset.any(axis=1)
    assert len(np.unique(offset[wrong], axis=0)) > 200
    changes = np.any(offset[1:] != offset[:-1], axis=1) & wrong[1:]
    # each of them in one piece
    assert changes.sum() == len(np.unique(offset[wrong], axis=0))
    # fixed for 60 s in the mean without float: 1 / (1/60 + 60/3600 + 30/3600)
    assert lengths(wrong).mean() == pytest.approx(60.0 / 2.0, rel=0.2)


def test_rates_of_the_sky_add_to_the_receivers_own() -> None:
    config = GnssSimulation(float_per_hour=10.0, lost_per_hour=5.0, refix_s=0.5, float_s=2.0, lost_s=2.0)
    status, _, _ = history(config, Sky(float_per_hour=20.0, lost_per_hour=10.0))
    assert len(lengths(status == GnssStatus.NONE)) / HOURS == pytest.approx(15.0, rel=0.15)
    # every loss ends in float too
    assert len(lengths(status == GnssStatus.FLOAT)) / HOURS == pytest.approx(45.0, rel=0.15)


def sensed(sky: Sky, config: GnssSimulation, speed: float = 10.0) -> tuple[GnssFix, GnssVelocity]:
    """What the receiver says over half an hour."""
    truth = cruise(1800.0, speed)
    course = straight(1810.0, speed, (18_100.0, "here", Environment(sky=sky)))
    sensor = GnssSensor(course, Vehicle(gnss_lever_arm=(0.5, 0.0, 1.2)), config, np.random.default_rng(1))
    return sensor.sense(truth.at(epochs(1800.0, 10.0)))


def measured(sky: Sky, config: GnssSimulation) -> tuple[GnssFix, NDArray[np.float64]]:
    """Fixes of half an hour and their errors (N, 3) ENU."""
    truth = cruise(1800.0)
    fix, _ = sensed(sky, config)
    place = truth.at(fix.t_ns).place_of((0.5, 0.0, 1.2))
    error = np.einsum("nji,nj->ni", rotation_ecef_enu(place), ecef_from_llh(fix.llh) - ecef_from_llh(place))
    return fix, error


def test_the_stated_covariance_knows_nothing_of_wrong_fixes_and_reflections() -> None:
    fix, error = measured(Sky(wrong_fix_per_hour=30.0), CALM)
    np.testing.assert_allclose(np.sqrt(fix.cov_enu[:, 0, 0]), 0.015)
    assert (np.hypot(error[:, 0], error[:, 1]) > 0.5).sum() > 300
    fix, error = measured(Sky(multipath_per_hour=60.0, multipath_m=10.0), CALM)
    far = np.hypot(error[:, 0], error[:, 1]) > 3.0
    assert far.sum() > 300
    np.testing.assert_allclose(np.sqrt(fix.cov_enu[far, 0, 0]), 0.4)


def test_an_error_of_metres_is_as_large_as_drawn() -> None:
    config = msgspec.structs.replace(CALM, fixed_sigma_m=1e-6)
    fix, error = measured(Sky(wrong_fix_per_hour=30.0), config)
    course = straight(1810.0, 10.0, (18_100.0, "here", Environment(sky=Sky(wrong_fix_per_hour=30.0))))
    again = np.random.default_rng(1).spawn(4)[0]
    _, offset, _ = RtkHistory(course, config, again).at(fix.t_ns)
    assert np.abs(offset).max() > 1.0
    np.testing.assert_allclose(error, offset, rtol=0, atol=1e-5)


@pytest.mark.parametrize("speed", [0.0, 10.0, 20.0])
def test_reflections_falsify_the_velocity_in_proportion_to_the_speed(speed: float) -> None:
    sky, config = Sky(multipath_per_hour=200.0, multipath_m=10.0), msgspec.structs.replace(CALM, velocity_sigma=1e-7)
    fix, velocity = sensed(sky, config, speed)
    error = velocity.vel_enu - cruise(1800.0, speed).at(velocity.t_ns).velocity_of((0.5, 0.0, 1.2))
    off = np.abs(error[:, 0]) > 1e-6
    jumps = np.unique(np.round(error[off, :2], 5), axis=0)
    # two per cent of the speed, about a hundred jumps
    assert np.sqrt(np.sum(jumps**2) / max(2 * len(jumps), 1)) == pytest.approx(0.02 * speed, rel=0.2)
    assert (fix.status[off] == GnssStatus.FLOAT).all()
    np.testing.assert_allclose(velocity.cov_enu[:, 0, 0], 1e-14)


def test_a_blocked_sky_leaves_no_velocities_either() -> None:
    fix, velocity = sensed(Sky(blocked=True), CALM)
    assert len(fix) == len(velocity) == 0
