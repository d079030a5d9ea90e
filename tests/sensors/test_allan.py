"""Allan deviations against NIST's published figures, and noise of known coefficients found again."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.allan import (
    AllanCurve,
    SensorNoise,
    allan_curve,
    gauss_markov_variance,
    noise_of,
    overlapping_variance,
    pooled,
)
from sensors.errors import EgolocError
from sensors.simulate.noise import gauss_markov

Floats = NDArray[np.float64]
STEP_S = 0.1


def angle_of(signal: Floats) -> Floats:
    return np.concatenate((np.zeros((1, signal.shape[1])), np.cumsum(signal, axis=0)))


def white(rng: np.random.Generator, count: int, walk: float, step_s: float = STEP_S) -> Floats:
    return walk / np.sqrt(step_s) * rng.standard_normal((count, 3))


def drifting(rng: np.random.Generator, count: int, sigma: float, time_s: float) -> Floats:
    return sigma * np.stack([gauss_markov(rng, count, STEP_S, time_s) for _ in range(3)], axis=-1)


def found(signal: Floats, step_s: float = STEP_S) -> SensorNoise:
    return noise_of(pooled(allan_curve(signal, step_s)))


def test_the_figures_of_nist() -> None:
    """NIST SP 1065, table 31: the overlapping Allan deviation of its 1000-point frequency data set."""
    n = [1234567890]
    for _ in range(999):
        n.append(16807 * n[-1] % 2147483647)
    angle = angle_of(np.array(n)[:, None] / 2147483647)
    deviations = [float(np.sqrt(overlapping_variance(angle, m))[0]) for m in (1, 10, 100)]
    assert deviations == pytest.approx([2.922319e-01, 9.159953e-02, 3.241343e-02], rel=2e-7)


def test_it_is_half_the_mean_square_of_differences_of_neighbouring_means() -> None:
    signal = np.random.default_rng(0).standard_normal((60, 2))
    means = np.array([signal[k : k + 7].mean(axis=0) for k in range(54)])
    expected = 0.5 * ((means[7:] - means[:-7]) ** 2).mean(axis=0)
    np.testing.assert_allclose(overlapping_variance(angle_of(signal), 7), expected, rtol=1e-12)


def test_a_curve_has_octaves_up_to_a_fifth_of_the_record() -> None:
    curve = allan_curve(np.random.default_rng(0).standard_normal((1000, 3)), 0.01)
    np.testing.assert_allclose(curve.tau, 0.01 * 2.0 ** np.arange(8))
    np.testing.assert_allclose(curve.clusters, 1000 / 2.0 ** np.arange(8))
    assert curve.span_s == pytest.approx(10.0)
    assert curve.error[-1] == pytest.approx(1 / np.sqrt(2 * (1000 / 128 - 1)))


@pytest.mark.parametrize("level", [0.0, 9.81, -1e4])
def test_a_constant_changes_nothing(level: float) -> None:
    signal = np.random.default_rng(1).standard_normal((5000, 3))
    apart = allan_curve(signal, 0.01).variance - allan_curve(signal + level, 0.01).variance
    assert np.abs(apart).max() < 1e-9


def test_gauss_markov_is_a_rate_random_walk_at_first_and_white_noise_in_the_end() -> None:
    assert gauss_markov_variance(np.array([1e-6]), 1.0) == pytest.approx(2e-6 / 3, rel=1e-5)
    assert gauss_markov_variance(np.array([1e6]), 1.0) == pytest.approx(2e-6, rel=1e-5)
    tau = np.array([0.999e-3, 1.001e-3])  # where the series ends
    series, closed = gauss_markov_variance(tau, 1.0)
    assert closed / series == pytest.approx(1.001 / 0.999, rel=1e-5)
    # the highest point: 0.618 sigma at 1.89 time constants (IEEE Std 952, C.1.2.6)
    tau = np.geomspace(0.1, 10, 4001)
    variance = gauss_markov_variance(tau, 1.0)
    assert tau[np.argmax(variance)] == pytest.approx(1.89, abs=0.01)
    assert np.sqrt(variance.max()) == pytest.approx(0.618, abs=0.001)


def test_white_noise_is_found_and_nothing_else() -> None:
    noise = found(white(np.random.default_rng(2), 72_000, 0.3))
    assert noise.random_walk == pytest.approx(0.3, rel=0.01)
    assert abs(noise.random_walk - 0.3) < 3 * noise.random_walk_error
    assert noise.drift_rate == 0.0
    assert not noise.instability_reached
    assert np.isinf(noise.drift_time_s)


def test_a_rate_random_walk_is_found() -> None:
    rng = np.random.default_rng(3)
    walk = np.cumsum(0.002 * np.sqrt(STEP_S) * rng.standard_normal((144_000, 3)), axis=0)
    noise = found(white(rng, 144_000, 0.3) + walk)
    assert noise.random_walk == pytest.approx(0.3, rel=0.01)
    assert noise.drift_rate == pytest.approx(0.002, rel=0.15)
    assert abs(noise.drift_rate - 0.002) < 3 * noise.drift_rate_error
    assert noise.drift_time_range_s[1] == np.inf
    # where both deviations cross, N / sqrt(tau) = K sqrt(tau / 3), to an octave
    assert 0.5 < noise.instability_tau_s / (np.sqrt(3) * 0.3 / 0.002) < 2.0
    assert noise.instability_reached


@pytest.mark.parametrize(("walk", "sigma", "time_s"), [(0.3, 0.5, 60.0), (1.0, 0.3, 200.0)])
def test_a_gauss_markov_drift_is_found(walk: float, sigma: float, time_s: float) -> None:
    rng = np.random.default_rng(4)
    count = round(400 * time_s / STEP_S)
    noise = found(white(rng, count, walk) + drifting(rng, count, sigma, time_s))
    assert noise.random_walk == pytest.approx(walk, rel=0.02)
    assert noise.drift_rate == pytest.approx(sigma * np.sqrt(2 / time_s), rel=0.1)
    assert noise.drift_sigma == pytest.approx(sigma, rel=0.15)
    assert noise.drift_time_s == pytest.approx(time_s, rel=0.3)
    assert noise.drift_time_range_s[0] < time_s * 1.2
    assert noise.drift_time_range_s[1] > time_s / 1.2


def test_quantization_does_not_pass_as_random_walk() -> None:
    """Angles with independent errors q: their increments have the Allan variance 3 q^2 / tau^2."""
    rng = np.random.default_rng(5)
    rounding = np.diff(0.006 * rng.standard_normal((72_001, 3)), axis=0) / STEP_S
    noise = found(white(rng, 72_000, 0.01) + rounding)
    assert noise.quantization == pytest.approx(0.006, rel=0.02)
    assert noise.random_walk == pytest.approx(0.01, rel=0.05)


def test_errors_are_as_large_as_stated() -> None:
    """Over 25 records of two hours: the error over its stated standard deviation."""
    rng = np.random.default_rng(6)
    walk, rate = [], []
    for _ in range(25):
        noise = found(white(rng, 72_000, 6.0) + drifting(rng, 72_000, 3.5, 500.0))
        walk.append((noise.random_walk - 6.0) / noise.random_walk_error)
        rate.append((noise.drift_rate - 3.5 * np.sqrt(2 / 500.0)) / noise.drift_rate_error)
    for scores in (walk, rate):
        assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.4
        assert abs(np.mean(scores)) < 0.6


def test_a_short_record_says_nothing_of_drifts() -> None:
    rng = np.random.default_rng(7)
    noise = found(white(rng, 5000, 0.3) + np.linspace(0, 5, 5000)[:, None])
    assert noise.drift_rate == 0.0
    assert not noise.instability_reached


def test_too_few_samples_and_samples_that_do_not_change_are_refused() -> None:
    with pytest.raises(EgolocError, match="at least 10 samples, got 9"):
        allan_curve(np.zeros((9, 3)), 0.01)
    curve = allan_curve(np.zeros((100, 3)), 0.01)
    with pytest.raises(EgolocError, match="do not change"):
        noise_of(curve)


def test_the_curve_of_all_axes_rests_on_more() -> None:
    curve = AllanCurve(np.ones(1), np.array([[1.0, 2.0, 6.0]]), np.array([5.0]), 5.0)
    together = pooled(curve)
    assert together.variance.tolist() == [[3.0]]
    assert together.error[0] == pytest.approx(curve.error[0] / np.sqrt(3))
