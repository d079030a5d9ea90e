"""Metrics against answers worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from replay.config import LIMITS, Limits
from replay.metrics import (
    axis_metrics,
    cover_ns,
    evaluated_span,
    method_metrics,
    well_known,
    within_limits,
)

S = 1_000_000_000
PERIOD = S // 10
PAPER = LIMITS["paper"]


def grid(*tenths: int) -> NDArray[np.int64]:
    return np.array(tenths, np.int64) * PERIOD


def errors(*rows: tuple[float, float, float]) -> NDArray[np.float64]:
    """Longitudinal m, lateral m, yaw deg."""
    table = np.array(rows, np.float64).reshape(-1, 3)
    table[:, 2] = np.radians(table[:, 2])
    return table


def whole(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """n epochs of 0.1 s and 1 m, all evaluated."""
    return np.full(n, float(PERIOD)), np.ones(n), float(n * PERIOD), float(n)


class TestAxis:
    def test_nothing_is_none(self) -> None:
        assert axis_metrics(np.empty(0), (0.1,)) is None
        assert axis_metrics(np.array([np.nan, np.nan]), (0.1,)) is None

    def test_one_sample(self) -> None:
        assert axis_metrics(np.array([-0.2]), (0.1, 0.2, 0.3)) == {
            "mae": 0.2,
            "rmse": 0.2,
            "p50": 0.2,
            "p95": 0.2,
            "p99": 0.2,
            "max": 0.2,
            "below": {"0.1": 0.0, "0.2": 0.0, "0.3": 1.0},  # below means less than
        }

    def test_three_errors_and_a_nan(self) -> None:
        found = axis_metrics(np.array([0.3, np.nan, -0.4, 0.0]), (0.1, 0.35))
        assert found is not None
        assert found["mae"] == pytest.approx(0.7 / 3)
        assert found["rmse"] == pytest.approx(np.sqrt(0.25 / 3))
        assert found["p50"] == pytest.approx(0.3)
        assert found["p95"] == pytest.approx(0.39)  # 0.3 + 0.9 (0.4 - 0.3)
        assert found["max"] == 0.4
        assert found["below"] == {"0.1": pytest.approx(1 / 3), "0.35": pytest.approx(2 / 3)}

    @given(st.lists(st.integers(-5000, 5000), min_size=1, max_size=50))
    def test_order_of_the_summaries(self, millimetres: list[int]) -> None:
        found = axis_metrics(np.array(millimetres) / 1000, (0.1, 0.2, 0.3))
        assert found is not None
        assert found["mae"] <= found["rmse"] * (1 + 1e-12) <= found["max"] * (1 + 1e-9)
        assert found["p50"] <= found["p95"] <= found["p99"] <= found["max"]
        assert 0 <= found["below"]["0.1"] <= found["below"]["0.2"] <= found["below"]["0.3"] <= 1


class TestCover:
    def test_back_to_the_one_before_but_no_further_than_one_and_a_half_periods(self) -> None:
        assert cover_ns(grid(0, 1, 2, 7, 8)).tolist() == [0, PERIOD, PERIOD, 1.5 * PERIOD, PERIOD]

    def test_the_first_covers_nothing(self) -> None:
        assert cover_ns(grid(3)).tolist() == [0]
        assert cover_ns(grid(3, 4), 2 * PERIOD).tolist() == [0, PERIOD]

    def test_no_fix(self) -> None:
        assert cover_ns(grid()).tolist() == []


class TestSpan:
    def test_one_second_at_ten_metres_per_second(self) -> None:
        span = evaluated_span(grid(*range(11)), np.ones(11, bool), np.full(11, 10.0), PERIOD)
        assert span.total_ns == S
        assert span.total_m == pytest.approx(10.0)

    def test_a_hole_in_the_grid_is_covered_by_half_a_period_more(self) -> None:
        span = evaluated_span(grid(0, 1, 8, 9), np.ones(4, bool), np.ones(4), PERIOD)
        assert span.total_ns == (1 + 1.5 + 1) * PERIOD

    def test_a_fix_stands_for_the_evaluated_part_of_its_cover(self) -> None:
        evaluated = np.array([True, True, False, False, True])
        span = evaluated_span(grid(0, 1, 2, 3, 4), evaluated, np.full(5, 5.0), PERIOD)
        time, distance = span.weights(grid(1, 3, 4) + PERIOD // 2, np.full(3, 2.0 * PERIOD))
        # ]-0.5, 1.5]: all of epoch 1's ]0, 1]; ]1.5, 3.5]: half of epoch 4's ]3, 4]; ]2.5, 4.5]: all of it
        assert time.tolist() == [PERIOD, 0.5 * PERIOD, PERIOD]
        assert distance == pytest.approx([0.5, 0.25, 0.5])

    def test_outside_nothing_is_evaluated(self) -> None:
        span = evaluated_span(grid(5, 6), np.ones(2, bool), np.ones(2), PERIOD)
        assert span.weights(grid(2, 30), np.full(2, float(PERIOD)))[0].tolist() == [0, 0]

    def test_empty(self) -> None:
        span = evaluated_span(grid(), np.empty(0, bool), np.empty(0), PERIOD)
        assert (span.total_ns, span.total_m) == (0, 0)
        assert span.weights(grid(1), np.array([1.0]))[0].tolist() == [0]

    def test_an_unknown_speed_adds_no_distance(self) -> None:
        span = evaluated_span(grid(0, 1), np.ones(2, bool), np.array([np.nan, 10.0]), PERIOD)
        assert span.total_m == pytest.approx(1.0)


class TestMethod:
    def test_all_axes_must_be_below(self) -> None:
        found = method_metrics(
            errors((0.5, 0.2, 0.9), (0.7, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 1.1)), *whole(4), PAPER
        )
        assert found["ar"] == 0.25
        assert found["coverage"] == 1.0

    def test_an_outage_still_open_at_the_end_counts_as_unavailable(self) -> None:
        time, distance, total_ns, total_m = whole(10)
        error = np.vstack((errors(*[(0.0, 0.0, 0.0)] * 6), np.full((4, 3), np.nan)))
        found = method_metrics(error, time, distance, total_ns, total_m, PAPER)
        assert (found["ar"], found["ar_distance"], found["coverage"]) == (0.6, 0.6, 0.6)
        assert found["lon"]["max"] == 0.0  # errors count epochs with output only

    def test_time_and_distance_weigh_differently(self) -> None:
        time, distance = np.array([3.0, 1.0]) * S, np.array([0.0, 40.0])
        found = method_metrics(errors((0, 0, 0), (1, 0, 0)), time, distance, 4.0 * S, 40.0, PAPER)
        assert (found["ar"], found["ar_distance"]) == (0.75, 0.0)

    def test_standing_has_no_distance_weighted_ratio(self) -> None:
        found = method_metrics(errors((0, 0, 0)), np.array([1.0]), np.array([0.0]), 1.0, 0.0, PAPER)
        assert found["ar"] == 1.0
        assert found["ar_distance"] is None

    def test_an_axis_that_is_never_estimated_is_left_out_of_the_ratio(self) -> None:
        found = method_metrics(errors((0.1, 0.1, np.nan), (0.7, 0.1, np.nan)), *whole(2), PAPER)
        assert found["ar"] == 0.5
        assert found["yaw"] is None

    def test_an_axis_that_is_sometimes_missing_is_unavailable_then(self) -> None:
        found = method_metrics(errors((0.1, 0.1, np.nan), (0.1, 0.1, 0.5)), *whole(2), PAPER)
        assert found["ar"] == 0.5
        assert found["coverage"] == 1.0
        assert found["yaw"]["max"] == pytest.approx(0.5)

    def test_no_output_at_all(self) -> None:
        found = method_metrics(np.empty((0, 3)), np.empty(0), np.empty(0), float(S), 10.0, PAPER)
        assert (found["ar"], found["coverage"], found["lon"]) == (0.0, 0.0, None)

    def test_nothing_evaluated_is_no_pass(self) -> None:
        found = method_metrics(errors((0, 0, 0)), np.zeros(1), np.zeros(1), 0.0, 0.0, PAPER)
        assert set(found.values()) == {None}

    def test_an_epoch_that_is_not_evaluated_adds_no_error(self) -> None:
        found = method_metrics(errors((9, 9, 9), (0, 0, 0)), np.array([0.0, S]), np.ones(2), float(S), 1.0, PAPER)
        assert (found["ar"], found["lon"]["max"]) == (1.0, 0.0)


def test_limits_are_exclusive() -> None:
    assert within_limits(errors((0.6, 0, 0), (0.5999, 0.2999, 0.9999)), PAPER, yaw=True).tolist() == [False, True]


def test_a_reference_must_be_three_times_better_than_the_limits() -> None:
    sigma = np.array([(0.099, 0.0), (0.101, 0.0), (0.05, np.radians(0.34)), (np.nan, np.nan)])
    position, yaw = well_known(sigma, Limits(0.6, 0.3, 1.0), yaw=True)
    assert position.tolist() == [True, False, True, True]
    assert yaw.tolist() == [True, True, False, True]
    assert well_known(sigma, Limits(0.6, 0.3, 1.0), yaw=False)[1].all()
