"""Innovations by themselves: made-up ones of known size and memory, and those of drives."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.innovations import AxisInnovations, autocovariance, consistency, joint
from fusion.result import Decisions, Reason, Sensor
from sensors.simulate.noise import gauss_markov

Floats = NDArray[np.float64]
STEP_NS = 100_000_000


def decided(innovation: Floats, sensor: Sensor, sigma: float = 2.0, reason: Reason = Reason.ACCEPTED) -> Decisions:
    """One decision every 0.1 s; innovation: (N, 3) in sigmas."""
    n = len(innovation)
    t_ns = 1_700_000_000_000_000_000 + np.arange(n) * STEP_NS
    codes = np.full(n, 3, np.int8)
    zero = np.zeros(n)
    return Decisions(
        t_ns,
        t_ns,
        np.full(n, sensor, np.int8),
        np.arange(n),
        np.full(n, reason, np.int8),
        sigma * innovation,
        np.where(np.isfinite(innovation), sigma, np.nan),
        zero,
        zero,
        codes,
        zero,
        zero,
        zero + 1.0,
    )


def by_axis(decisions: Decisions) -> dict[str, AxisInnovations]:
    return {axis.axis: axis for axis in consistency(decisions)}


def test_white_innovations_of_a_known_size() -> None:
    rng = np.random.default_rng(1)
    found = by_axis(decided(rng.standard_normal((4000, 3)) * (1.0, 1.0, 1.5), Sensor.GNSS_POSITION))
    assert set(found) == {"horizontal", "vertical"}
    assert found["horizontal"].count == 4000
    assert found["horizontal"].factor == pytest.approx(1.0, abs=4 * np.sqrt(2 / 8000))
    assert found["vertical"].factor == pytest.approx(2.25, rel=4 * np.sqrt(2 / 4000))
    assert found["vertical"].factor_error == pytest.approx(2.25 * np.sqrt(2 / 4000), rel=0.15)
    for axis in found.values():
        assert axis.share == 0.0
        assert axis.correlation_s is None


def test_innovations_that_last() -> None:
    """A share of 0.6 that lasts 3 s; each drive of 10 min has 200 of these times."""
    rng = np.random.default_rng(2)
    lasting = np.stack([gauss_markov(rng, 6000, 0.1, 3.0) for _ in range(3)], axis=-1)
    scores = np.sqrt(0.6) * lasting + np.sqrt(0.4) * rng.standard_normal((6000, 3))
    found = by_axis(decided(scores, Sensor.POSE_FIX))
    assert set(found) == {"longitudinal", "lateral", "yaw"}
    for axis in found.values():
        assert axis.share == pytest.approx(0.6, abs=0.12)
        assert axis.correlation_s == pytest.approx(3.0, rel=0.35)
        assert abs(axis.factor - 1.0) < 3 * axis.factor_error
        assert axis.factor_error > 2 * np.sqrt(2 / 6000)


def test_the_stated_error_of_the_factor_is_its_scatter() -> None:
    rng = np.random.default_rng(3)
    scores = []
    for _ in range(60):
        axis = by_axis(decided(gauss_markov(rng, 3000, 0.1, 2.0)[:, None] * [1, 0, 0] + [0, 1, 1], Sensor.POSE_FIX))
        scores.append((axis["longitudinal"].factor - 1.0) / axis["longitudinal"].factor_error)
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.4


@pytest.mark.parametrize("reason", [Reason.CHI_SQUARE, Reason.PARTLY_ACCEPTED, Reason.BEFORE_ALIGNMENT])
def test_only_whole_applied_measurements_count(reason: Reason) -> None:
    assert consistency(decided(np.ones((100, 3)), Sensor.POSE_FIX, reason=reason)) == ()


def test_few_innovations_and_missing_components_say_nothing() -> None:
    assert consistency(decided(np.ones((49, 3)), Sensor.GNSS_POSITION)) == ()
    one = np.random.default_rng(4).standard_normal((100, 3))
    one[:, 1:] = np.nan
    found = consistency(decided(one, Sensor.WHEEL))
    assert [(axis.sensor, axis.axis, axis.count) for axis in found] == [(Sensor.WHEEL, "forward", 100)]


def test_pairs_across_a_pause_do_not_count() -> None:
    t_ns = np.array([0, 1, 2, 3, 50, 51, 52, 53]) * STEP_NS
    scores = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])[:, None]
    products, pairs = autocovariance(t_ns, scores, float(STEP_NS))
    assert pairs.tolist() == [8, 6]
    assert products.tolist() == [np.mean(scores**2), (2 + 6 + 12 + 30 + 42 + 56) / 6]


def test_joint_innovations_leave_missing_components_out() -> None:
    one = np.ones((5, 3))
    one[:, 2] = np.nan
    decisions = decided(one, Sensor.GNSS_POSITION)
    value, variance = joint(decisions, (Sensor.GNSS_POSITION,), int(decisions.t_ns[1]))
    assert value.tolist() == [[2.0, 2.0, 0.0]] * 3
    assert variance.tolist() == [[4.0, 4.0, 1.0]] * 3
    assert len(joint(decisions, (Sensor.POSE_FIX,), 0)[0]) == 0
