"""Pose fixes: errors against covariance, its shape along the road, arrival, map axes."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2, kstest

from sensors.geodesy import MapFrame, map_from_llh
from sensors.records import PoseFix
from sensors.rotation import wrap
from sensors.simulate.drive import Drive, DriveConfig, Start, featureless, simulate_drive
from sensors.simulate.noise import stamps
from sensors.simulate.pose_fix import PoseFixSensor
from sensors.simulate.pose_fix_config import PoseFixSimulation
from sensors.simulate.trajectory import Truth
from sensors.vehicle import Vehicle

WHITE = PoseFixSimulation(correlated_fraction=0.0)


def fixes(drive: Drive, config: PoseFixSimulation, seed: int = 0, vehicle: Vehicle | None = None) -> PoseFix:
    motion = drive.truth.at(stamps(drive.truth.start_ns, 600.0, config.rate_hz, config.phase_s))
    course, rng = featureless(drive.truth), np.random.default_rng(seed)
    return PoseFixSensor(course, frame_of(drive), vehicle or Vehicle(), config, rng).sense(motion)


def frame_of(drive: Drive) -> MapFrame:
    assert drive.log.map_frame is not None
    return drive.log.map_frame


def course_in_map(truth: Truth, frame: MapFrame, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(N,) direction of travel by differences of map coordinates, NaN below 2 m/s."""
    ahead, behind = (map_from_llh(frame, truth.at(t_ns + d).llh) for d in (1_000_000, -1_000_000))
    moved = (ahead - behind)[:, :2]
    return np.where(np.linalg.norm(moved, axis=1) > 4e-3, np.arctan2(moved[:, 1], moved[:, 0]), np.nan)


def errors(drive: Drive, fix: PoseFix) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(N, 3) against the truth in map axes, the yaw's by the course; (N,) rows that move."""
    course = course_in_map(drive.truth, frame_of(drive), fix.t_ns)
    place = map_from_llh(frame_of(drive), drive.truth.at(fix.t_ns).llh)
    e = fix.pose - np.column_stack((place[:, :2], course))
    e[:, 2] = wrap(e[:, 2])
    return e, np.isfinite(course)


def in_vehicle_axes(cov: NDArray[np.float64], yaw: NDArray[np.float64]) -> NDArray[np.float64]:
    rotation = np.zeros((len(yaw), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(yaw)
    rotation[:, 0, 1], rotation[:, 1, 0] = np.sin(yaw), -np.sin(yaw)
    rotation[:, 2, 2] = 1.0
    return rotation @ cov @ np.swapaxes(rotation, 1, 2)


def test_errors_have_the_stated_covariance(drive: Drive) -> None:
    fix = fixes(drive, WHITE)
    e, moving = errors(drive, fix)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(fix.cov), e)[moving]
    assert len(nees) > 3000
    assert kstest(nees, chi2(3).cdf).pvalue > 0.01


def test_correlated_errors_have_the_stated_covariance_and_memory(drive: Drive) -> None:
    config = PoseFixSimulation(correlated_fraction=0.5, correlation_s=2.0)
    unit = []
    for seed in range(5):
        fix = fixes(drive, config, seed)
        yaw_error = np.nan_to_num(errors(drive, fix)[0][:, 2])
        unit.append(yaw_error / np.sqrt(fix.cov[:, 2, 2]))
    column = np.stack(unit)
    moving = np.isfinite(course_in_map(drive.truth, frame_of(drive), fix.t_ns))
    assert column[:, moving].var() == pytest.approx(1.0, rel=0.08)
    both = moving[20:] & moving[:-20]
    memory = np.mean((column[:, 20:] * column[:, :-20])[:, both])
    assert memory == pytest.approx(0.5 * np.exp(-1.0), abs=0.06)


def test_covariance_lies_along_the_vehicle(drive: Drive) -> None:
    fix = fixes(drive, msgspec.structs.replace(WHITE, blind_per_hour=60.0))
    course = course_in_map(drive.truth, frame_of(drive), fix.t_ns)
    moving = np.isfinite(course)
    cov = in_vehicle_axes(fix.cov[moving], course[moving])
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[:, 1], 0.03, rtol=1e-3)
    np.testing.assert_allclose(np.degrees(sigma[:, 2]), 0.13, rtol=1e-9)
    assert np.abs(cov[:, 0, 1]).max() < 1e-4
    blind = sigma[:, 0] > 0.3
    assert 0.4999 < sigma[blind, 0].min() < sigma[blind, 0].max() < 0.9001
    assert 0.0299 < sigma[~blind, 0].min() < 0.045
    assert 0.08 < sigma[~blind, 0].max() < 0.1001
    # it varies along the road, not from fix to fix
    assert np.median(np.abs(np.diff(np.log(sigma[~blind, 0])))) < 0.05


def test_blind_stretches_last_some_seconds(drive: Drive) -> None:
    fix = fixes(drive, WHITE)
    largest = np.linalg.eigvalsh(fix.cov[:, :2, :2])[:, 1] > 0.3**2
    edges = np.flatnonzero(np.diff(np.concatenate(([0], largest, [0])).astype(int)))
    lengths = np.diff(edges)[::2] * 0.1
    assert 1 <= len(lengths) <= 10
    assert lengths.min() > 2.8
    assert not fixes(drive, msgspec.structs.replace(WHITE, blind_per_hour=0.0)).cov[:, :2, :2].max() > 0.3**2


def test_fixes_arrive_120_ms_late_and_in_order(drive: Drive) -> None:
    fix = drive.log.pose_fixes
    assert fix is not None
    delay = (fix.arrival_ns - fix.t_ns) * 1e-9
    assert delay.mean() == pytest.approx(0.12, abs=3e-4)
    assert delay.std() == pytest.approx(0.003, rel=0.1)
    assert (np.diff(fix.arrival_ns) > 0).all()
    assert fix.t_ns[0] == drive.truth.start_ns + 30_000_000


def test_the_pose_point_is_honoured(drive: Drive) -> None:
    exact = PoseFixSimulation(
        longitudinal_min_m=1e-6, longitudinal_max_m=1e-6, lateral_m=1e-6, yaw_deg=1e-6, blind_per_hour=0.0
    )
    here = fixes(drive, exact)
    ahead = fixes(drive, exact, vehicle=Vehicle(pose_lever_arm=(2.0, 0.0, 0.0)))
    moved = ahead.pose[:, :2] - here.pose[:, :2]
    along = np.column_stack((np.cos(here.pose[:, 2]), np.sin(here.pose[:, 2])))
    np.testing.assert_allclose(moved, 2.0 * along, rtol=0, atol=5e-3)


@pytest.mark.parametrize("kind", ["utm", "enu"])
@pytest.mark.parametrize("place", [(48.1, 11.6), (-33.9, 18.4), (60.0, -149.0)])
def test_reference_heads_where_it_goes_in_map_axes(kind: str, place: tuple[float, float]) -> None:
    config = DriveConfig(start=Start(latitude_deg=place[0], longitude_deg=place[1]), map_frame=kind)  # type: ignore[arg-type]
    drive = simulate_drive(120.0, 1, config)
    reference = drive.log.reference
    assert reference is not None
    assert reference.q_map_body is not None
    course = course_in_map(drive.truth, frame_of(drive), reference.t_ns)
    x, y, z, w = reference.q_map_body.T
    forward = np.column_stack((1 - 2 * (y * y + z * z), 2 * (x * y + z * w)))
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    moving = np.isfinite(course)
    assert moving.sum() > 2000
    assert np.abs(wrap(yaw - course)[moving]).max() < 1e-5
