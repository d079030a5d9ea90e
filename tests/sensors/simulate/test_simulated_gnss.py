"""GNSS errors against their stated covariance, the RTK schedule, lever arm and arrival."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2, kstest

from sensors.geodesy import ecef_from_llh, rotation_ecef_enu
from sensors.records import GnssFix, GnssStatus
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate.drive import Drive, featureless
from sensors.simulate.gnss import GnssSensor
from sensors.simulate.gnss_config import GnssSimulation
from sensors.simulate.noise import stamps
from sensors.simulate.rtk import RtkHistory
from sensors.simulate.trajectory import Truth
from sensors.vehicle import Vehicle
from tests.sensors.simulate.courses import epochs, straight

WHITE = GnssSimulation(correlated_fraction=0.0)
VEHICLE = Vehicle(gnss_lever_arm=(0.5, 0.0, 1.2))


def errors(fix: GnssFix, truth: Truth, vehicle: Vehicle) -> NDArray[np.float64]:
    """(N, 3) ENU, m, against the antenna's true place."""
    place = truth.at(fix.t_ns).place_of(vehicle.gnss_lever_arm)
    ecef = ecef_from_llh(fix.llh) - ecef_from_llh(place)
    return np.einsum("nji,nj->ni", rotation_ecef_enu(place), ecef)


def run(truth: Truth, config: GnssSimulation, seed: int = 0):  # type: ignore[no-untyped-def]
    motion = truth.at(stamps(truth.start_ns, 600.0, config.rate_hz))
    return GnssSensor(featureless(truth), VEHICLE, config, np.random.default_rng(seed)).sense(motion)


def test_white_errors_have_the_stated_covariance(truth: Truth) -> None:
    fix, velocity = run(truth, WHITE)
    e = errors(fix, truth, VEHICLE)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(fix.cov_enu), e)
    assert kstest(nees, chi2(3).cdf).pvalue > 0.01
    e = velocity.vel_enu - truth.at(velocity.t_ns).velocity_of(VEHICLE.gnss_lever_arm)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(velocity.cov_enu), e)
    assert kstest(nees, chi2(3).cdf).pvalue > 0.01


def test_correlated_errors_have_the_stated_covariance_and_memory(truth: Truth) -> None:
    config = GnssSimulation(float_per_hour=0.0, lost_per_hour=0.0, correlated_fraction=0.7, correlation_s=5.0)
    unit = np.stack([errors(run(truth, config, seed)[0], truth, VEHICLE) for seed in range(8)])
    unit /= np.array([1.0, 1.0, config.vertical_ratio]) * config.fixed_sigma_m
    assert unit.var() == pytest.approx(1.0, rel=0.05)
    for lag_s in (1, 5, 10):
        memory = np.mean(unit[:, lag_s * 10 :] * unit[:, : -lag_s * 10])
        assert memory == pytest.approx(0.7 * np.exp(-lag_s / 5.0), abs=0.05)


def test_schedule_is_fixed_most_of_the_time_and_floats_after_a_loss() -> None:
    config = GnssSimulation()
    t_ns = epochs(100 * 3600.0, 10.0)
    status, offset, _ = RtkHistory(straight(100 * 3600.0), config, np.random.default_rng(0)).at(t_ns)
    assert not offset.any()
    assert np.mean(status == GnssStatus.FIXED) == pytest.approx(0.94, abs=0.02)
    begins = np.flatnonzero(np.diff(status)) + 1
    before, after = status[begins - 1], status[begins]
    upsets = before == GnssStatus.FIXED
    losses = upsets & (after == GnssStatus.NONE)
    assert losses.sum() / 100 == pytest.approx(config.lost_per_hour, rel=0.15)
    assert (upsets & (after == GnssStatus.FLOAT)).sum() / 100 == pytest.approx(config.float_per_hour, rel=0.15)
    assert np.mean(after[before == GnssStatus.NONE] == GnssStatus.FLOAT) > 0.95
    lengths = np.diff(begins) * 0.1
    assert lengths[after[:-1] == GnssStatus.NONE].mean() == pytest.approx(config.lost_s, rel=0.15)


def test_a_loss_leaves_no_rows_and_float_is_less_certain(drive: Drive) -> None:
    fix, velocity = drive.log.gnss, drive.log.gnss_velocity
    assert fix is not None
    assert velocity is not None
    assert set(fix.status) == {GnssStatus.FLOAT, GnssStatus.FIXED}
    np.testing.assert_array_equal(fix.t_ns, velocity.t_ns)
    assert np.diff(fix.t_ns).max() > 500_000_000
    sigma = np.sqrt(fix.cov_enu[:, 0, 0])
    np.testing.assert_allclose(sigma, np.where(fix.status == GnssStatus.FLOAT, 0.4, 0.015))


def test_without_upsets_every_epoch_is_fixed(truth: Truth) -> None:
    fix, _ = run(truth, GnssSimulation(float_per_hour=0.0, lost_per_hour=0.0))
    assert len(fix) == 6001
    assert (fix.status == GnssStatus.FIXED).all()


def test_positions_are_those_of_the_antenna(truth: Truth) -> None:
    config = GnssSimulation(
        float_per_hour=0.0, lost_per_hour=0.0, fixed_sigma_m=1e-9, velocity_sigma=1e-9, velocity_vertical_sigma=1e-9
    )
    fix, velocity = run(truth, config)
    body = truth.at(fix.t_ns).llh
    arm = np.linalg.norm(ecef_from_llh(fix.llh) - ecef_from_llh(body), axis=1)
    np.testing.assert_allclose(arm, np.hypot(0.5, 1.2), rtol=0, atol=1e-7)
    around = stamps(truth.start_ns + 50_000_000, 599.0, 10.0)
    step = 1_000_000
    ahead = ecef_from_llh(truth.at(around + step).place_of(VEHICLE.gnss_lever_arm))
    behind = ecef_from_llh(truth.at(around - step).place_of(VEHICLE.gnss_lever_arm))
    moved = np.einsum("nji,nj->ni", rotation_ecef_enu(truth.at(around).llh), (ahead - behind) / 2e-3)
    np.testing.assert_allclose(moved, truth.at(around).velocity_of(VEHICLE.gnss_lever_arm), rtol=0, atol=1e-4)
    expected = truth.at(velocity.t_ns).velocity_of(VEHICLE.gnss_lever_arm)
    np.testing.assert_allclose(velocity.vel_enu, expected, rtol=0, atol=1e-7)
    assert np.abs(expected - truth.at(velocity.t_ns).vel_enu).max() > 0.1


def test_dual_antenna_yaw_comes_with_fixed_solutions_only(truth: Truth) -> None:
    assert np.isnan(run(truth, WHITE)[0].yaw).all()
    fix, _ = run(truth, msgspec.structs.replace(WHITE, dual_antenna=True))
    fixed = fix.status == GnssStatus.FIXED
    assert np.isnan(fix.yaw[~fixed]).all()
    assert (~fixed).any()
    error = wrap(fix.yaw - yaw_from_q(truth.at(fix.t_ns).q_enu_body))[fixed]
    assert np.degrees(error.std()) == pytest.approx(0.2, rel=0.05)
    np.testing.assert_allclose(fix.yaw_sigma[fixed], np.radians(0.2))


def test_fixes_arrive_later_with_a_small_jitter(drive: Drive) -> None:
    fix = drive.log.gnss
    assert fix is not None
    delay = (fix.arrival_ns - fix.t_ns) * 1e-9
    assert delay.mean() == pytest.approx(0.05, abs=2e-4)
    assert delay.std() == pytest.approx(0.002, rel=0.1)
