"""Figures against answers worked out by hand: sums of a few outputs on a grid of ten epochs a second."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from replay.cells import Cells
from replay.config import LIMITS, Limits
from replay.metrics import method_metrics, well_known
from replay.outputs import Outputs, Waiting, cover_ns, longest_cover_ns
from replay.segments import AXES, METHODS

S = 1_000_000_000
PERIOD = S // 10
PAPER = LIMITS["paper"]
NAMES = {"log": ("drive",), "scene": ("",), "mode": ("",), "method": METHODS}


def stamps(*tenths: float) -> NDArray[np.int64]:
    return np.round(np.array(tenths, np.float64) * PERIOD).astype(np.int64)


def errors(*rows: tuple[float, float, float]) -> NDArray[np.float64]:
    """Longitudinal m, lateral m, yaw deg."""
    return np.array(rows, np.float64).reshape(-1, 3)


def figures(
    outputs: Outputs, grid: Outputs, speed: float | NDArray[np.float64] = 10.0, limits: Limits = PAPER
) -> dict[str, Any]:
    """The entry of a method with these outputs, where the grid is evaluated."""
    cells = Cells(limits, 0)
    cells.find(np.zeros(1, np.int64), np.zeros(1, np.int16), np.zeros(1, np.int16))
    speeds = np.broadcast_to(np.float64(speed), grid.t_ns.shape).copy()
    cells.add_grid(grid.cell, grid.cover_ns, speeds)
    cells.add_outputs("fusion", outputs, grid, speeds)
    sketch = cells.histograms.sketch(lambda key: ("", "", METHODS[key[2]], AXES[key[3]]))
    return method_metrics(cells.table(["fusion"], NAMES), sketch, "fusion")


def outputs(t_ns: NDArray[np.int64], cover: object, error: NDArray[np.float64] | None = None) -> Outputs:
    error = np.zeros((len(t_ns), 3)) if error is None else error
    return Outputs(t_ns, np.asarray(cover, np.int64), np.zeros(len(t_ns), np.int64), error)


def whole(error: NDArray[np.float64], epochs: int | None = None, **given: Limits) -> dict[str, Any]:
    """Outputs that stand for an epoch of 0.1 s and 1 m each, the first of `epochs` (else all) that are evaluated."""
    t_ns = stamps(*range(1, (epochs or len(error)) + 1))
    grid = outputs(t_ns, np.full(len(t_ns), PERIOD))
    return figures(outputs(t_ns[: len(error)], np.full(len(error), PERIOD), error), grid, **given)


class TestAxis:
    def test_one_sample(self) -> None:
        lon = whole(errors((-0.2, 0, 0)))["lon"]
        assert lon == {
            "mae": 0.2,
            "rmse": pytest.approx(0.2),
            "p50": 0.2,  # within 0.2 %, and no larger than the largest
            "p95": 0.2,
            "p99": 0.2,
            "max": 0.2,
            "below": {"0.1": 0.0, "0.2": 0.0, "0.3": 1.0},  # below means less than
        } | {name: pytest.approx(0.2, rel=2e-3) for name in ("p50", "p95", "p99")}

    def test_three_errors(self) -> None:
        lon = whole(errors((0.3, 0, 0), (-0.4, 0, 0), (0, 0, 0)))["lon"]
        assert lon["mae"] == pytest.approx(0.7 / 3)
        assert lon["rmse"] == pytest.approx(np.sqrt(0.25 / 3))
        assert lon["p50"] == pytest.approx(0.3, rel=2e-3)
        assert lon["p95"] == pytest.approx(0.39, rel=2e-3)  # 0.3 + 0.9 (0.4 - 0.3)
        assert lon["max"] == 0.4
        assert lon["below"] == {"0.1": 1 / 3, "0.2": 1 / 3, "0.3": 1 / 3}

    @given(st.lists(st.integers(-5000, 5000), min_size=1, max_size=50))
    def test_order_of_the_summaries(self, millimetres: list[int]) -> None:
        found = whole(errors(*((mm / 1000, 0, 0) for mm in millimetres)))["lon"]
        assert found["mae"] <= found["rmse"] * (1 + 1e-12) <= found["max"] * (1 + 1e-9)
        assert found["p50"] <= found["p95"] <= found["p99"] <= found["max"]
        assert 0 <= found["below"]["0.1"] <= found["below"]["0.2"] <= found["below"]["0.3"] <= 1


class TestCover:
    def test_back_to_the_one_before_but_no_further_than_one_and_a_half_periods(self) -> None:
        longest = longest_cover_ns(PERIOD)
        assert longest == 1.5 * PERIOD
        assert cover_ns(stamps(0, 1, 2, 7, 8), longest).tolist() == [0, PERIOD, PERIOD, longest, PERIOD]

    def test_the_first_covers_nothing_unless_one_came_before(self) -> None:
        assert cover_ns(stamps(3), PERIOD).tolist() == [0]
        assert cover_ns(stamps(3), PERIOD, int(stamps(2.5)[0])).tolist() == [PERIOD // 2]

    def test_no_fix(self) -> None:
        assert cover_ns(stamps(), PERIOD).tolist() == []


class TestWaiting:
    def test_the_nominal_period_is_that_of_the_first_minutes(self) -> None:
        waiting = Waiting()
        t_ns = np.r_[np.arange(0, 301 * S, S), 301 * S + np.arange(0, 50 * S, 5 * S)]  # then only every 5 s
        waiting.add(t_ns, np.arange(len(t_ns)), np.zeros(len(t_ns), np.int64), np.zeros((len(t_ns), 3)))
        assert set(waiting.take(None).cover_ns[302:].tolist()) == {round(1.5 * S)}

    def test_nothing_is_taken_before_the_nominal_period_is_known(self) -> None:
        waiting = Waiting()
        for t_ns in (stamps(1, 2), stamps(3, 4)):
            waiting.add(t_ns, t_ns, np.zeros(2, np.int64), np.zeros((2, 3)))
            assert len(waiting.take(S).t_ns) == 0
        assert waiting.take(None).cover_ns.tolist() == [0, PERIOD, PERIOD, PERIOD]

    def test_a_fix_that_comes_twice_counts_once(self) -> None:
        waiting = Waiting()
        for row in (np.array([0, 1, 1]), np.array([1, 2, 3])):
            waiting.add(stamps(*row.tolist()), row, np.zeros(3, np.int64), np.zeros((3, 3)))
        assert waiting.take(None).t_ns.tolist() == stamps(0, 1, 2, 3).tolist()

    def test_a_single_fix_stands_for_nothing(self) -> None:
        waiting = Waiting()
        waiting.add(stamps(5), np.array([0]), np.zeros(1, np.int64), np.zeros((1, 3)))
        assert waiting.take(None).cover_ns.tolist() == [0]


class TestGrid:
    def test_a_fix_stands_for_the_evaluated_part_of_its_cover(self) -> None:
        grid = outputs(stamps(1, 4), [PERIOD, PERIOD])  # ]0, 1] and ]3, 4] are evaluated
        fixes = outputs(stamps(1.5, 3.5), [2 * PERIOD, 2 * PERIOD])  # ]-0.5, 1.5] and ]1.5, 3.5]
        found = figures(fixes, grid, speed=5.0)
        assert found["coverage"] == 0.75
        assert found["ar_distance"] == 0.75

    def test_outside_nothing_is_evaluated(self) -> None:
        grid = outputs(stamps(5, 6), [0, PERIOD])
        found = figures(outputs(stamps(2, 30), [PERIOD, PERIOD]), grid)
        assert (found["coverage"], found["lon"]) == (0.0, None)

    def test_an_unknown_speed_adds_no_distance(self) -> None:
        t_ns = stamps(*range(1, 21))
        speed = np.where(np.arange(20) < 10, 0.0, 10.0)  # what scoring makes of a NaN is 0
        error = np.repeat(errors((0, 0, 0), (9, 0, 0)), 10, axis=0)
        found = figures(outputs(t_ns, np.full(20, PERIOD), error), outputs(t_ns, np.full(20, PERIOD)), speed)
        assert (found["ar"], found["ar_distance"]) == (0.5, 0.0)


class TestMethod:
    def test_all_axes_must_be_below(self) -> None:
        found = whole(errors((0.5, 0.2, 0.9), (0.7, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 1.1)))
        assert found["ar"] == 0.25
        assert found["coverage"] == 1.0

    def test_an_outage_still_open_at_the_end_counts_as_unavailable(self) -> None:
        found = whole(errors(*[(0.0, 0.0, 0.0)] * 6), epochs=10)
        assert (found["ar"], found["ar_distance"], found["coverage"]) == (0.6, 0.6, 0.6)
        assert found["lon"]["max"] == 0.0  # errors count epochs with output only

    def test_a_fix_without_reference_counts_for_and_against_nothing(self) -> None:
        found = whole(errors((0, 0, 0), (np.nan, np.nan, np.nan), (1, 0, 0)))
        assert (found["ar"], found["coverage"]) == (0.5, 1.0)

    def test_standing_has_no_distance_weighted_ratio(self) -> None:
        t_ns = stamps(1)
        found = figures(outputs(t_ns, [PERIOD]), outputs(t_ns, [PERIOD]), speed=0.0)
        assert found["ar"] == 1.0
        assert found["ar_distance"] is None

    def test_an_axis_that_is_never_estimated_is_left_out_of_the_ratio(self) -> None:
        found = whole(errors((0.1, 0.1, np.nan), (0.7, 0.1, np.nan)))
        assert found["ar"] == 0.5
        assert found["yaw"] is None

    def test_an_axis_that_is_sometimes_missing_is_unavailable_then(self) -> None:
        found = whole(errors((0.1, 0.1, np.nan), (0.1, 0.1, 0.5)))
        assert found["ar"] == 0.5
        assert found["coverage"] == 1.0
        assert found["yaw"]["max"] == 0.5

    def test_no_output_at_all(self) -> None:
        found = whole(np.empty((0, 3)), epochs=10)
        assert (found["ar"], found["coverage"], found["lon"]) == (0.0, 0.0, None)

    def test_nothing_evaluated_is_no_pass(self) -> None:
        found = figures(outputs(stamps(1), [PERIOD]), outputs(stamps(), []))
        assert set(found.values()) == {None}

    def test_an_epoch_that_is_not_evaluated_adds_no_error(self) -> None:
        fixes = outputs(stamps(1, 2), [PERIOD, PERIOD], errors((9, 9, 9), (0, 0, 0)))
        found = figures(fixes, outputs(stamps(2), [PERIOD]))
        assert (found["ar"], found["lon"]["max"]) == (1.0, 0.0)

    def test_a_diverged_filter_has_figures(self) -> None:
        lon = whole(errors((1e300, 0, 0), (0, 0, 0)))["lon"]
        assert (lon["max"], lon["mae"]) == (1e100, 5e99)
        assert np.isfinite([*lon["below"].values(), lon["rmse"], lon["p99"]]).all()


def test_limits_are_exclusive() -> None:
    found = whole(errors((0.6, 0, 0), (0.5999, 0.2999, 0.9999), (0, 0.3, 0), (0, 0, 1.0)))
    assert found["ar"] == 0.25


def test_a_reference_must_be_three_times_better_than_the_limits() -> None:
    sigma = np.array([(0.099, 0.0), (0.101, 0.0), (0.05, np.radians(0.34)), (np.nan, np.nan)])
    position, yaw = well_known(sigma, Limits(0.6, 0.3, 1.0), heading=np.ones(4, bool))
    assert position.tolist() == [True, False, True, True]
    assert yaw.tolist() == [True, True, False, True]
    assert well_known(sigma, Limits(0.6, 0.3, 1.0), heading=np.zeros(4, bool))[1].all()
