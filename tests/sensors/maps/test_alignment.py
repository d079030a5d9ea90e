"""Registration and alignment on a street: what drifts comes back to centimetres, and sigmas tell the truth."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.maps.accumulation import accumulation
from sensors.maps.alignment import AlignConfig, Alignment, align
from sensors.maps.corrections import ErrorModel
from sensors.maps.registration import RegistrationConfig, Scan, register, sampled, scan_of, thinned
from sensors.maps.surfels import surfels_of
from sensors.records import Trajectory
from sensors.rotation import matrix_from_q, q_from_matrix, wrap, yaw_from_q
from tests.sensors.maps.street import around, block, frames

Floats = NDArray[np.float64]

SIGMA_M, SIGMA_YAW, LEVEL = 0.3, np.radians(0.3), np.radians(0.1)
TAU_S = 10.0
CONFIG = AlignConfig(errors=ErrorModel(correlation_s=TAU_S, sigma_level_deg=0.1))
STREET = block(21)
TRUTH = around(STREET, 0.45)
LAP = around(STREET, 1.25)


@pytest.fixture(scope="module")
def seen() -> list[Frame]:
    return list(frames(STREET, TRUTH, every_ns=300_000_000, seed=1, azimuths=240))


@pytest.fixture(scope="module")
def cloud() -> Floats:
    """An earlier survey of the street."""
    again = frames(STREET, LAP, every_ns=1_000_000_000, seed=2, azimuths=300)
    return np.concatenate([part.xyz for part in accumulation(LAP).placed(again)])


def drifted(truth: Trajectory, seed: int) -> Trajectory:
    """Errors of a critically damped second-order Gauss-Markov process: smooth, as those of an INS."""
    rng = np.random.default_rng(seed)
    a = np.exp(-0.02 * 2.0 / TAU_S)
    warm = 5000
    unit = lfilter([1.0], [1.0, -2 * a, a * a], rng.normal(size=(6, warm + len(truth))))[:, warm:].T
    error = unit / np.sqrt((1 + a * a) / (1 - a * a) ** 3) * [LEVEL, LEVEL, SIGMA_YAW, SIGMA_M, SIGMA_M, 1.5 * SIGMA_M]
    turned = Rotation.from_rotvec(error[:, :3]).as_matrix() @ matrix_from_q(truth.q_map_body)
    sigma = np.tile((SIGMA_M, SIGMA_YAW), (len(truth), 1))
    return Trajectory(truth.t_ns, truth.t_ns, truth.p_map + error[:, 3:], q_from_matrix(turned), sigma)


def errors(found: Trajectory, truth: Trajectory) -> tuple[Floats, Floats]:
    """(N, 2) m and (N,) rad at the rows found."""
    row = np.searchsorted(truth.t_ns, found.t_ns)
    assert np.array_equal(truth.t_ns[row], found.t_ns)
    return (found.p_map - truth.p_map[row])[:, :2], wrap(
        yaw_from_q(found.q_map_body) - yaw_from_q(truth.q_map_body[row])
    )


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(np.atleast_2d(values.T) ** 2, axis=0))))


def scans(seen: list[Frame], count: int) -> list[tuple[Scan, Floats]]:
    parts = list(accumulation(TRUTH).placed(seen[:count]))
    return [(scan_of(thinned((p.xyz - p.T_map_body[:3, 3]) @ p.T_map_body[:3, :3], 0.4)), p.T_map_body) for p in parts]


def test_a_match_finds_the_motion_and_its_covariance_is_honest(seen: list[Frame]) -> None:
    rng = np.random.default_rng(8)
    ready = scans(seen, 30)
    nees = []
    for (target, T_i), (source, T_j) in zip(ready[:-2], ready[2:], strict=True):
        truth = np.linalg.solve(T_i, T_j)
        nudge = np.eye(4)
        nudge[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.5), 3)).as_matrix()
        nudge[:3, 3] = rng.normal(0.0, 0.3, 3)
        match = register(target, source, truth @ nudge, RegistrationConfig())
        assert match.refused == ""
        away = np.linalg.solve(truth, match.T)
        error = np.concatenate((Rotation.from_matrix(away[:3, :3]).as_rotvec(), away[:3, 3]))
        assert np.linalg.norm(error[3:]) < 0.02
        assert np.degrees(np.linalg.norm(error[:3])) < 0.08
        nees.append(error @ np.linalg.solve(match.cov, error) / 6.0)
    # honest: not too sure, nor so unsure that it says nothing
    assert 0.03 < np.mean(nees) < 1.2


def test_the_covariance_does_not_depend_on_where_the_target_lies(seen: list[Frame]) -> None:
    (target, T_i), (source, T_j) = scans(seen, 2)
    points = np.array(target.points.points())[:, :3]
    shift = np.eye(4)
    shift[:3, 3] = [800.0, -500.0, 20.0]
    guess = np.linalg.solve(T_i, T_j)
    here = register(target, source, guess, RegistrationConfig())
    there = register(scan_of(points + shift[:3, 3]), source, shift @ guess, RegistrationConfig())
    np.testing.assert_allclose(there.T, shift @ here.T, atol=1e-3)
    np.testing.assert_allclose(there.cov, here.cov, rtol=0.05, atol=1e-9)


def test_what_does_not_fit_is_refused(seen: list[Frame]) -> None:
    (target, _), (source, _) = scans(seen, 2)
    far = np.eye(4)
    far[:3, 3] = [0.0, 0.0, 30.0]
    assert "found a partner" in register(target, source, far, RegistrationConfig()).refused
    few = scan_of(np.random.default_rng(1).uniform(0.0, 5.0, (50, 3)))
    assert "fewer than 200 points" in register(target, few, np.eye(4), RegistrationConfig()).refused


def test_a_corridor_without_ends_leaves_its_length_unknown() -> None:
    rng = np.random.default_rng(9)
    along = rng.uniform(-30.0, 30.0, 9000)
    across = rng.uniform(-4.0, 4.0, 9000)
    walls = np.where(np.arange(9000) % 3 == 0, 4.0, -4.0)
    side = np.arange(9000) % 3 < 2
    points = np.column_stack((along, np.where(side, walls, across), np.where(side, rng.uniform(0.0, 3.0, 9000), 0.0)))
    halves = [
        scan_of(thinned(points[part] + rng.normal(0.0, 0.01, (4500, 3)), 0.4))
        for part in (slice(0, 4500), slice(4500, 9000))
    ]
    match = register(halves[0], halves[1], np.eye(4), RegistrationConfig())
    sigma = np.sqrt(np.diag(match.cov))
    assert sigma[3] > 0.5
    assert max(sigma[4], sigma[5]) < 0.02


def test_frames_against_a_surveyed_cloud_give_centimetres(seen: list[Frame], cloud: Floats) -> None:
    position, yaw = [], []
    for seed in (31, 32):
        given = drifted(TRUTH, seed)
        found = align(seen, given, cloud, CONFIG)
        before, _ = errors(given, TRUTH)
        off, turned = errors(found.trajectory, TRUTH)
        assert rms(before) > 0.15
        assert rms(off) < 0.02
        assert np.degrees(rms(turned)) < 0.03
        assert found.frames == len(seen)
        position.append(np.mean((off**2).sum(axis=1) / found.trajectory.sigma[:, 0] ** 2) / 2.0)
        yaw.append(np.mean(turned**2 / found.trajectory.sigma[:, 1] ** 2))
    assert 0.05 < np.mean(position) < 1.5
    assert 0.01 < np.mean(yaw) < 1.5


def test_frames_against_the_surfels_of_a_map(seen: list[Frame], cloud: Floats) -> None:
    surfels = surfels_of(cloud)
    points = sampled(np.column_stack((surfels.p, surfels.z)), surfels.normal, 0.4)
    found = align(seen, drifted(TRUTH, 33), points, CONFIG)
    off, turned = errors(found.trajectory, TRUTH)
    assert rms(off) < 0.1
    assert np.degrees(rms(turned)) < 0.15


def test_frames_against_each_other_give_the_shape(seen: list[Frame]) -> None:
    given = drifted(TRUTH, 34)
    found = align(seen, given, None, CONFIG)
    assert shape_error(given, TRUTH) > 0.05
    assert shape_error(found.trajectory, TRUTH) < 0.02
    off, _ = errors(found.trajectory, TRUTH)
    # what is common to all of the drive no frame can tell: sigma says so
    assert rms(off) < 4 * np.median(found.trajectory.sigma[:, 0])
    assert np.median(found.trajectory.sigma[:, 0]) > 0.1


def shape_error(found: Trajectory, truth: Trajectory) -> float:
    """Horizontal error, rms m, after the best shift and turn of the whole."""
    row = np.searchsorted(truth.t_ns, found.t_ns)
    inside = row < len(truth)
    p, q = found.p_map[inside, :2], truth.p_map[row[inside], :2]
    p, q = p - p.mean(axis=0), q - q.mean(axis=0)
    u, _, v = np.linalg.svd(p.T @ q)
    return rms(p @ (u @ v) - q)


@pytest.mark.slow
def test_sigmas_of_a_drive_with_a_loop_are_honest() -> None:
    """Over seeded drifts of one drive: its mean squared error against what sigma promises."""
    ring = list(frames(STREET, LAP, every_ns=300_000_000, seed=5, azimuths=240))
    ratio = []
    for seed in range(500, 512):
        found: Alignment = align(ring, drifted(LAP, seed), None, CONFIG)
        assert found.loops > 5
        assert shape_error(found.trajectory, LAP) < 0.02
        off, _ = errors(found.trajectory, LAP)
        ratio.append(np.mean((off**2).sum(axis=1) / found.trajectory.sigma[:, 0] ** 2) / 2.0)
    # about two numbers a drive are free, and no more: 24 in all
    assert 0.4 < np.mean(ratio) < 1.9


def test_nothing_to_align_is_said() -> None:
    with pytest.raises(EgolocError, match="got 0 that can be used"):
        align([], TRUTH)
    early = Frame(int(TRUTH.t_ns[0]) - 10**9, 0)
    with pytest.raises(EgolocError, match="1 outside of the trajectory"):
        align([early], TRUTH)


def test_a_cloud_of_another_place_is_said(seen: list[Frame], cloud: Floats) -> None:
    with pytest.raises(EgolocError, match="no frame could be registered"):
        align(seen[:3], TRUTH, cloud + np.array([5000.0, 0.0, 0.0]), CONFIG)
