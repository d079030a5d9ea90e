"""Sampling a reference: accuracy, gaps, course."""

import numpy as np
import pytest
from numpy.typing import NDArray

from replay.references import Excluded, along_left, gap_ns, lever, only, sample
from sensors.records import Trajectory
from sensors.rotation import q_from_rpy, wrap

S = 1_000_000_000


def seconds(*values: float) -> NDArray[np.int64]:
    return np.rint(np.array(values) * S).astype(np.int64)


def circle(t_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """10 m/s around 20 m: 5 m/s^2 sideways. Positions and yaw."""
    phase = t_ns / S / 2
    return np.stack((20 * np.cos(phase), 20 * np.sin(phase), 0 * phase), axis=-1), phase + np.pi / 2


def circle_at(hz: float, *, attitude: bool = True, duration_s: float = 20.0) -> Trajectory:
    t_ns = np.rint(np.arange(0, duration_s, 1 / hz) * S).astype(np.int64)
    p, yaw = circle(t_ns)
    q = q_from_rpy(0 * yaw, 0 * yaw, yaw) if attitude else None
    return Trajectory(t_ns, t_ns, p, q)  # type: ignore[arg-type]


@pytest.mark.parametrize(("hz", "tolerance"), [(4.0, 1e-3), (10.0, 5e-5), (100.0, 1e-6)])
def test_positions_between_rows(hz: float, tolerance: float) -> None:
    at = np.rint(np.arange(1, 18, 0.0137) * S).astype(np.int64)
    found = sample(circle_at(hz), at)
    assert np.abs(found.p_map - circle(at)[0]).max() < tolerance
    linear = np.abs(np.interp(at, circle_at(hz).t_ns, circle_at(hz).p_map[:, 0]) - circle(at)[0][:, 0]).max()
    assert np.abs(found.p_map[:, 0] - circle(at)[0][:, 0]).max() < linear / 10


def test_the_kernel_equals_a_plain_parabola_blend() -> None:
    """Against Hermite's basis, with end velocities from np.gradient (second order, uneven steps)."""
    rng = np.random.default_rng(3)
    t_ns = np.cumsum(rng.integers(S // 12, S // 8, 60))
    p = rng.normal(size=(60, 3)).cumsum(axis=0)
    known = Trajectory(t_ns, t_ns, p)
    at = np.sort(rng.integers(t_ns[1], t_ns[-2], 500))
    t, v = t_ns / S, np.gradient(p, t_ns / S, axis=0, edge_order=2)
    i = np.searchsorted(t_ns, at, side="right") - 1
    h = (t[i + 1] - t[i])[:, None]
    u = (at / S - t[i])[:, None] / h
    basis = ((1 + 2 * u) * (1 - u) ** 2, u * (1 - u) ** 2, u * u * (3 - 2 * u), u * u * (u - 1))
    expected = basis[0] * p[i] + basis[1] * h * v[i] + basis[2] * p[i + 1] + basis[3] * h * v[i + 1]
    np.testing.assert_allclose(sample(known, at).p_map, expected, atol=1e-9)


def test_times_in_any_order_and_on_the_rows() -> None:
    known = circle_at(10.0)
    at = known.t_ns[[150, 3, 80, 0, len(known) - 1]]
    found = sample(known, at)
    np.testing.assert_allclose(found.p_map, circle(at)[0], atol=1e-12)
    assert (found.excluded == Excluded.EVALUATED).all()


def test_yaw_across_the_branch_cut() -> None:
    at = np.rint(np.arange(0.5, 19, 0.0137) * S).astype(np.int64)  # yaw runs through +-180 deg
    found = sample(circle_at(10.0), at)
    assert found.has_heading
    assert np.abs(wrap(found.heading - circle(at)[1])).max() < 1e-5


def test_a_gap_is_not_evaluated_and_not_differentiated_across() -> None:
    known = circle_at(10.0)
    kept = (known.t_ns <= 5 * S) | (known.t_ns >= 6 * S)
    found = sample(known[kept], seconds(4.95, 5.0, 5.05, 5.95, 6.0, 6.05))
    assert found.excluded.tolist() == [0, 0, Excluded.GAP, Excluded.GAP, 0, 0]
    assert np.isnan(found.p_map[2]).all()
    good = [0, 1, 4, 5]
    assert np.abs(found.p_map - circle(found.t_ns)[0])[good].max() < 2e-3
    assert np.abs(found.speed - 10.0)[good].max() < 0.1


def test_the_order_of_the_times_does_not_matter() -> None:
    known = circle_at(10.0)
    known = known[~((known.t_ns > 5 * S) & (known.t_ns < 6 * S))]
    at = np.rint(np.arange(-0.5, 20.5, 0.0137) * S).astype(np.int64)
    shuffled = np.random.default_rng(0).permutation(len(at))
    in_order, mixed = sample(known, at), sample(known, at[shuffled])
    for name in ("p_map", "speed", "heading", "excluded"):
        np.testing.assert_array_equal(getattr(mixed, name), getattr(in_order, name)[shuffled])


def test_a_missing_row_is_bridged() -> None:
    known = circle_at(10.0)
    found = sample(known[known.t_ns != 5 * S], seconds(4.97, 5.03))
    assert (found.excluded == Excluded.EVALUATED).all()
    assert np.abs(found.p_map - circle(found.t_ns)[0]).max() < 1e-3


def test_gap_limit_follows_the_period_within_bounds() -> None:
    assert gap_ns(seconds(*np.arange(0, 5, 0.01))) == S // 4
    assert gap_ns(seconds(*np.arange(0, 5, 0.25))) == 625_000_000
    assert gap_ns(seconds(0, 10, 20, 30)) == 1.5 * S  # so slow a reference is not interpolated at all


def test_outside_the_reference() -> None:
    found = sample(circle_at(10.0)[20:40], seconds(1.9, 2.0, 3.9, 4.0))
    assert found.excluded.tolist() == [Excluded.OUTSIDE, 0, 0, Excluded.OUTSIDE]
    assert np.isnan(found.heading[[0, 3]]).all()


def test_course_where_there_is_no_attitude() -> None:
    at = np.rint(np.arange(1, 18, 0.0137) * S).astype(np.int64)
    found = sample(circle_at(4.0, attitude=False), at)
    assert not found.has_heading
    assert np.degrees(np.abs(wrap(found.heading - circle(at)[1]))).max() < 0.1
    assert np.isnan(found.q_map_body).all()


def test_course_below_one_metre_per_second_is_excluded() -> None:
    t_ns = seconds(*np.arange(0, 20, 0.1))
    s = t_ns / S
    p = np.stack((0.1 * s**2, 0 * s, 0 * s), axis=-1)  # 0.2 m/s^2: 1 m/s after 5 s
    found = sample(Trajectory(t_ns, t_ns, p), seconds(4.8, 5.2, 10.0))
    assert found.excluded.tolist() == [Excluded.SLOW, 0, 0]
    assert found.speed == pytest.approx([0.96, 1.04, 2.0])
    assert np.isfinite(found.p_map).all()


def test_rows_without_attitude_among_others_are_excluded() -> None:
    known = circle_at(10.0)
    q = known.q_map_body.copy()
    q[50:60] = np.nan
    found = sample(Trajectory(known.t_ns, known.t_ns, known.p_map, q), seconds(4.5, 5.5, 6.5))
    assert found.excluded.tolist() == [0, Excluded.NO_HEADING, 0]


@pytest.mark.parametrize("rows", [0, 1])
def test_almost_no_reference(rows: int) -> None:
    found = sample(circle_at(10.0)[:rows], seconds(0.0, 1.0))
    assert found.excluded.tolist() == ([Excluded.OUTSIDE] * 2 if rows == 0 else [0, Excluded.OUTSIDE])


def test_along_and_left_of_the_heading() -> None:
    t_ns = seconds(0, 1)
    north = Trajectory(t_ns, t_ns, np.zeros((2, 3)), q_from_rpy([0, 0], [0, 0], [np.pi / 2] * 2))
    found = along_left(sample(north, t_ns[:1]), np.array([[1.0, 2.0]]))
    np.testing.assert_allclose(found, [[2.0, -1.0]], atol=1e-12)


def test_lever_arms_turn_with_whichever_attitude_is_known() -> None:
    at = seconds(np.pi)  # yaw: pi / 2 + pi / 2, westward
    arm, estimate = (2.0, 1.0, 0.5), np.eye(3)[None]
    west = [[-2.0, -1.0, 0.5]]
    np.testing.assert_allclose(lever(sample(circle_at(100.0), at), arm, estimate), west, atol=1e-6)
    course_only = sample(circle_at(100.0, attitude=False), at)
    np.testing.assert_allclose(lever(course_only, arm), west, atol=1e-3)
    np.testing.assert_allclose(lever(course_only, arm, estimate), [arm])


def test_only_leaves_the_chosen_ones() -> None:
    found = only(sample(circle_at(10.0), seconds(1, 2, 3)), np.array([False, True, False]))
    assert found.excluded.tolist() == [Excluded.NOT_HIDDEN, 0, Excluded.NOT_HIDDEN]
    assert np.isfinite(found.p_map).all(axis=1).tolist() == [False, True, False]
