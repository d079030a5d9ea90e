"""A gyro whose vertical axis leans: what is stated of roll, pitch and accelerometer bias, told and untold."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.axes import add_lean, with_lean
from fusion.config import Estimate, FusionConfig
from fusion.filter import Localizer
from fusion.layout import OFF
from fusion.run import run
from fusion.smoother import smooth
from fusion.timeline import parameters
from replay.bench.consistency import AS_DRAWN, nees
from sensors._kernels import STANDARD_GRAVITY
from sensors.simulate.drive import simulate_drive
from sensors.simulate.imu_presets import ImuFlaws
from sensors.simulate.scenarios import load
from sensors.vehicle import ImuSpec, Vehicle
from tests.fusion.free import random_covariance

LEAN_DEG = 0.04


def leaning(sigma_deg: float) -> Vehicle:
    return Vehicle(imu=ImuSpec(gyro_misalignment_deg=sigma_deg))


def test_both_ways_of_stating_it_agree() -> None:
    rng = np.random.default_rng(4)
    nav = rng.standard_normal(17)
    nav[6:10] /= np.linalg.norm(nav[6:10])
    P = random_covariance(4, np.ones(16))[:15, :15]
    pose, variance = np.r_[0:3, 6:9], 0.3
    sigma, pose_cov = np.sqrt(np.diag(P)), P[np.ix_(pose, pose)].copy()
    add_lean(nav, variance, sigma, pose_cov)
    whole = with_lean(P, nav, variance)
    assert sigma == pytest.approx(np.sqrt(np.diag(whole)), rel=1e-12)
    np.testing.assert_allclose(pose_cov, whole[np.ix_(pose, pose)], rtol=1e-12, atol=1e-12)
    assert np.diag(whole - P)[12:15] == pytest.approx(variance * STANDARD_GRAVITY**2 * np.array([1.0, 1.0, 0.0]))


def test_a_lean_makes_no_force_with_its_bias() -> None:
    """On level ground: -[f]x of the attitude error less R of the bias, f upward."""
    nav = np.zeros(17)
    nav[6:10] = (0.0, 0.0, np.sin(0.4), np.cos(0.4))
    of_lean = with_lean(np.zeros((15, 15)), nav, 1.0)
    c, s = np.cos(0.8), np.sin(0.8)
    force = np.zeros((3, 15))
    force[:, 6:9] = -np.array([[0.0, -STANDARD_GRAVITY, 0.0], [STANDARD_GRAVITY, 0.0, 0.0], [0.0, 0.0, 0.0]])
    force[:, 12:15] = -np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert np.abs(force @ of_lean @ force.T).max() < 1e-12
    assert of_lean[6, 6] == pytest.approx(1.0)


def test_states_stand_for_a_large_one_and_where_they_are_asked_for() -> None:
    plain, asked = FusionConfig(), FusionConfig(estimate=Estimate(gyro=True))
    assert parameters(leaning(0.0), plain).axes_var == 0.0
    small = parameters(leaning(0.02), plain)
    assert (small.axes_var, small.layout.gyro_misalignment) == (np.radians(0.02) ** 2, OFF)
    for vehicle, config in ((leaning(0.2), plain), (leaning(0.02), asked)):
        large = parameters(vehicle, config)
        assert large.axes_var == 0.0
        assert large.layout.gyro_misalignment != OFF


def test_nees_is_honest_where_the_filter_is_told() -> None:
    """Drives whose IMU has only misaligned axes, eight draws; untold it is sure of what nothing shows."""
    clean = load("clean")
    scene = msgspec.structs.replace(
        clean, imu=msgspec.structs.replace(clean.imu, flaws=ImuFlaws(misalignment_deg=LEAN_DEG))
    )
    spec = msgspec.structs.replace(clean.vehicle.imu, gyro_misalignment_deg=LEAN_DEG, accel_misalignment_deg=LEAN_DEG)
    told = msgspec.structs.replace(scene, vehicle=msgspec.structs.replace(clean.vehicle, imu=spec))
    found = {}
    for name, each in (("untold", scene), ("told", told)):
        scores = [nees(simulate_drive(100.0, 700 + k, each), AS_DRAWN) for k in range(8)]
        blocks = [[np.nanmean(drive[block]) / 3 for block in ("attitude", "accelerometer bias")] for drive in scores]
        found[name] = np.mean(blocks, axis=0)
    print(found)
    assert (found["told"] < 1.5).all()
    assert (found["told"] > 0.4).all()
    assert (found["untold"] > 2.5).all()


def test_every_output_states_it() -> None:
    """Recorded, smoothed, in arrival order and live: the variances of the same filter untold, and the lean's."""
    log = simulate_drive(30.0, 5, load("clean")).log
    imu = msgspec.structs.replace(log.vehicle.imu, gyro_misalignment_deg=LEAN_DEG)
    told = replace(log, vehicle=msgspec.structs.replace(log.vehicle, imu=imu))
    variance = np.radians(LEAN_DEG) ** 2
    late = FusionConfig(order="arrival")
    pairs = [
        (run(log).states, run(told).states),
        (run(log, late).states, run(told, late).states),
        (smooth(log)[1], smooth(told)[1]),
    ]
    for untold, stated in pairs:
        assert np.array_equal(untold.q_enu_body, stated.q_enu_body)
        grown = stated.sigma**2 - untold.sigma**2
        assert grown[:, 6:8].mean() == pytest.approx(variance, rel=0.01)
        assert grown[:, 12:14] == pytest.approx(np.full((len(grown), 2), variance * STANDARD_GRAVITY**2), rel=1e-6)
        assert np.abs(grown[:, :6]).max() == 0.0
    live = [Localizer(each.vehicle, each.map_frame) for each in (log, told)]
    for localizer in live:
        for record in (log.gnss, log.gnss_velocity, log.pose_fixes, log.imu):
            assert record is not None
            localizer.push(record)
    before, after = (localizer.covariance() for localizer in live)
    assert before is not None
    assert after is not None
    assert np.diag(after - before)[12] == pytest.approx(variance * STANDARD_GRAVITY**2, rel=1e-6)
