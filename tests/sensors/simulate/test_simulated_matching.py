"""What happens to map matching along a road: correlated errors, degenerate stretches, look-alikes, gross errors."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh, utm_frame
from sensors.records import PoseFix
from sensors.rotation import wrap
from sensors.simulate.course import Course
from sensors.simulate.drive import DriveConfig
from sensors.simulate.environment import Environment, Landmarks
from sensors.simulate.pose_fix import PoseFixSensor
from sensors.simulate.pose_fix_config import PoseFixSimulation
from sensors.simulate.reference import yaw_in_map
from sensors.vehicle import Vehicle
from tests.sensors.simulate.courses import cruise, epochs, straight

Floats = NDArray[np.float64]

PLAIN = PoseFixSimulation(blind_per_hour=0.0, correlated_fraction=0.0, phase_s=0.0)
BOUND = msgspec.structs.replace(PLAIN, map_fraction=0.4, feature_fraction=0.4, lateral_spread=0.378, yaw_spread=0.52)
DURATION_S = 3600.0


def fixes(
    config: PoseFixSimulation, course: Course | None = None, seed: int = 0, speed: float = 10.0, *, night: bool = False
) -> tuple[PoseFix, Floats, Floats]:
    """Fixes of an hour, with errors (N, 3) and stated sigmas (N, 3) along, left and in yaw."""
    truth = cruise(DURATION_S, speed)
    frame = utm_frame(truth.at(epochs(0.0, 1.0)).llh[0])
    course = course or straight(DURATION_S + 10, speed)
    sensor = PoseFixSensor(course, frame, Vehicle(), config, np.random.default_rng(seed), night=night)
    fix = sensor.sense(truth.at(epochs(DURATION_S, config.rate_hz)))
    motion = truth.at(fix.t_ns)
    yaw = yaw_in_map(motion, frame)
    d = fix.pose[:, :2] - map_from_llh(frame, motion.llh)[:, :2]
    c, s = np.cos(yaw), np.sin(yaw)
    error = np.stack((c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], wrap(fix.pose[:, 2] - yaw)), axis=-1)
    along = np.stack((c, s), axis=-1)
    left = np.stack((-s, c), axis=-1)
    variance = [np.einsum("ni,nij,nj->n", axis, fix.cov[:, :2, :2], axis) for axis in (along, left)]
    return fix, error, np.sqrt(np.stack((*variance, fix.cov[:, 2, 2]), axis=-1))


def among(landmarks: Landmarks, speed: float = 10.0) -> Course:
    end = speed * (DURATION_S + 10)
    return straight(DURATION_S + 10, speed, (end, "here", Environment(landmarks=landmarks)))


def correlation_over_place(error: Floats, step_m: float, lag_m: float) -> float:
    """Autocorrelation of errors (N,) at places step_m apart."""
    lag = round(lag_m / step_m)
    return float(np.mean(error[lag:] * error[:-lag]) / np.mean(error**2))


@pytest.mark.parametrize("axis", [1, 2])
def test_most_of_the_lateral_and_yaw_variance_is_correlated_over_200_m(axis: int) -> None:
    # 20 drives of 36 km on roads of their own, a fix every metre
    errors = [fixes(BOUND, straight(DURATION_S + 10, seed=seed), seed)[1][:, axis] for seed in range(20)]
    share = np.mean([correlation_over_place(e, 1.0, 1.0) for e in errors])
    assert 0.7 <= share < 0.85
    at_200_m = np.mean([correlation_over_place(e, 1.0, 200.0) for e in errors])
    # correlation length: where the correlated part has fallen to 1/e
    assert at_200_m >= share / np.e


def test_what_is_bound_to_the_place_stands_still_with_the_vehicle() -> None:
    _, error, sigma = fixes(BOUND, straight(DURATION_S + 10, 0.0), speed=0.0)
    unit = error / sigma
    # only the white fifth is left
    np.testing.assert_allclose(unit.std(axis=0), np.sqrt(0.2), rtol=0.03)
    halves = unit[:18_000].mean(axis=0) - unit[18_000:].mean(axis=0)
    assert np.abs(halves).max() < 0.03


def test_the_maps_part_is_the_same_for_every_drive_on_a_road_and_the_features_are_not() -> None:
    def unit(road: int, drive: int) -> Floats:
        _, error, sigma = fixes(BOUND, straight(DURATION_S + 10, seed=road), drive)
        return error / sigma

    first = [unit(road, road) for road in range(8)]
    again = [unit(road, 100 + road) for road in range(8)]
    shared = np.mean([np.mean(a * b, axis=0) for a, b in zip(first, again, strict=True)], axis=0)
    np.testing.assert_allclose(shared, 0.4, atol=0.1)
    foreign = np.mean([np.mean(a * b, axis=0) for a, b in zip(first, again[1:], strict=False)], axis=0)
    np.testing.assert_allclose(foreign, 0.0, atol=0.1)


def test_the_sum_of_all_parts_has_the_stated_covariance() -> None:
    unit = np.concatenate([e / s for _, e, s in (fixes(BOUND, straight(3610.0, seed=k), k) for k in range(12))])
    np.testing.assert_allclose(unit.var(axis=0), 1.0, atol=0.1)


def test_the_stated_sigma_varies_along_the_road_as_stated() -> None:
    _, _, sigma = fixes(BOUND, seed=4)
    assert np.log(sigma[:, 1]).std() == pytest.approx(0.378, rel=0.15)
    assert np.log(sigma[:, 2]).std() == pytest.approx(0.52, rel=0.15)
    assert np.median(sigma[:, 1]) == pytest.approx(0.03, rel=0.15)
    assert np.abs(np.diff(np.log(sigma[:, 1]))).max() < 0.1


def test_scarce_landmarks_and_night_make_it_less_certain() -> None:
    _, _, rich = fixes(PLAIN)
    _, _, poor = fixes(PLAIN, among(Landmarks(scarcity=1.5)))
    np.testing.assert_allclose(poor[:, 0], 1.5 * rich[:, 0])
    np.testing.assert_allclose(poor[:, 1:], rich[:, 1:])
    _, _, dark = fixes(msgspec.structs.replace(PLAIN, night_factor=1.3), night=True)
    np.testing.assert_allclose(dark, 1.3 * rich)
    _, _, day = fixes(msgspec.structs.replace(PLAIN, night_factor=1.3))
    np.testing.assert_allclose(day, rich)


def test_a_degenerate_stretch_gives_the_prior_with_a_saturated_sigma() -> None:
    config = msgspec.structs.replace(PLAIN, prior_drift=0.02)
    _, error, sigma = fixes(config, among(Landmarks(degenerate_per_km=2.0, degenerate_m=100.0)))
    lost = sigma[:, 0] > 0.3
    # 0.2 of the road, less where stretches overlap
    assert lost.mean() == pytest.approx(1 - np.exp(-0.2), abs=0.06)
    for window in config.window_sigmas_m:
        here = (sigma[:, 0] > 0.9 * window - 1e-6) & (sigma[:, 0] <= window + 1e-6)
        assert here.sum() > 200
        assert np.abs(error[here, 0]).max() <= np.sqrt(3.0) * window + 1e-6
    assert np.abs(error[lost, 0]).max() > 1.0
    begins = lost & ~np.roll(lost, 1)
    assert np.abs(error[begins, 0]).max() < 0.1
    assert np.abs(error[~lost, 0]).max() < 0.5
    assert sigma[:, 1:].std(axis=0).max() < 1e-9


def test_flatness_from_one_level_on_can_be_chosen() -> None:
    config = msgspec.structs.replace(PLAIN, flat_shares=(0.0, 0.0, 1.0))
    _, _, sigma = fixes(config, among(Landmarks(degenerate_per_km=2.0)))
    lost = sigma[sigma[:, 0] > 0.3, 0]
    assert 0.423 - 1e-6 <= lost.min() < lost.max() <= 0.47 + 1e-6


@pytest.mark.parametrize(("axis", "distance"), [(0, 6.0), (1, 3.5)])
def test_look_alikes_shift_by_a_dash_or_a_lane_with_the_covariance_of_two_modes(axis: int, distance: float) -> None:
    rate = {"dash_alias_per_km": 2.0} if axis == 0 else {"lane_alias_per_km": 2.0}
    _, error, sigma = fixes(PLAIN, among(Landmarks(**rate)))
    off = np.abs(error[:, axis]) > 1.0
    assert off.mean() == pytest.approx(0.03, rel=0.35)
    assert np.abs(error[off, axis]).mean() == pytest.approx(distance, rel=0.02)
    assert 0.2 < np.mean(error[off, axis] > 0) < 0.8
    # half and half: the widest; nearly all in the wrong one: as narrow as ever
    assert sigma[off, axis].max() == pytest.approx(0.5 * distance, rel=0.05)
    assert sigma[off, axis].min() < 0.25 * distance
    other = 1 - axis
    assert np.abs(error[off, other]).max() < 0.5


def test_gross_errors_come_at_their_rate_with_the_usual_covariance() -> None:
    config = msgspec.structs.replace(PLAIN, gross_per_hour=200.0)
    _, error, sigma = fixes(config)
    gross = np.degrees(np.abs(error[:, 2])) > 4.0
    assert gross.mean() == pytest.approx(200 * 0.5 / 3600, rel=0.25)
    size = np.degrees(np.abs(error[gross, 2]))
    assert 7.3 < size.min() < size.max() < 16.7
    assert size.mean() == pytest.approx(12.0, rel=0.08)
    np.testing.assert_allclose(np.degrees(sigma[:, 2]), 0.13)
    assert (np.abs(error[gross, 0]) > 0.6).mean() == pytest.approx(0.55, rel=0.2)
    assert np.abs(error[~gross, 0]).max() < 0.6
    assert sigma[:, 0].max() < 0.101


def test_frames_are_dropped_singly_and_in_bursts() -> None:
    fix, _, _ = fixes(msgspec.structs.replace(PLAIN, dropped_fraction=0.05))
    assert len(fix) == pytest.approx(0.95 * 36_001, rel=0.005)
    fix, _, _ = fixes(msgspec.structs.replace(PLAIN, burst_per_hour=100.0, burst_s=2.0))
    gaps = np.diff(fix.t_ns) * 1e-9
    assert (gaps > 0.15).sum() == pytest.approx(100, rel=0.25)
    assert gaps[gaps > 0.15].mean() == pytest.approx(2.1, rel=0.3)


def test_a_constant_yaw_offset_is_covered_by_the_stated_sigma() -> None:
    _, error, sigma = fixes(msgspec.structs.replace(PLAIN, yaw_offset_deg=0.1))
    assert np.degrees(error[:, 2].mean()) == pytest.approx(0.1, abs=0.005)
    np.testing.assert_allclose(np.degrees(sigma[:, 2]), np.hypot(0.1, 0.13))


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"map_fraction": 0.6, "feature_fraction": 0.3}, "expected at most 1, got 1.2 - at `$.pose_fix`"),
        ({"gross_yaw_min_deg": 20.0}, "gross_yaw_min_deg: expected at most gross_yaw_max_deg (16), got 20"),
        ({"flat_shares": [0.0, 0.0, 0.0]}, "flat_shares: expected one above 0, got none"),
        ({"window_sigmas_m": [1.0, 1.0]}, "Expected `array` of length 3, got 2 - at `$.pose_fix.window_sigmas_m`"),
    ],
)
def test_a_mistake_in_the_config_is_one_line(given: dict[str, object], complaint: str) -> None:
    with pytest.raises((msgspec.ValidationError, EgolocError)) as caught:
        msgspec.convert({"pose_fix": given}, DriveConfig)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)
