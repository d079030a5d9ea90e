"""Histograms that add up, and the percentiles read from them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from replay.sketch import ACCURACY, BINS, Histograms, Key, Sketch, bins, middle, percentiles
from sensors.errors import EgolocError

ONE: Key = ("city", "", "gnss", "lon")
OTHER: Key = ("canyon,night", "autonomous", "fusion", "yaw")


def counted(numbers: Sequence[float] | NDArray[np.float64]) -> NDArray[np.int64]:
    return np.bincount(bins(np.asarray(numbers, np.float64)), minlength=BINS)


@given(st.floats(1e-12, 1e12))
def test_a_bin_stands_for_each_of_its_numbers(number: float) -> None:
    assert middle(bins(np.array([number])))[0] == pytest.approx(number, rel=ACCURACY)


def test_bins_increase_and_reach_from_nothing_to_everything() -> None:
    assert (np.diff(middle(np.arange(BINS - 1))) > 0).all()
    assert bins(np.array([0.0, 1e-300, 1e-13, 1e13, 1e100])).tolist() == [0, 0, 0, BINS - 1, BINS - 1]
    assert middle(np.array([0, BINS - 1])).tolist() == [0.0, np.inf]


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=200))
def test_percentiles_are_those_of_the_numbers_to_the_stated_accuracy(numbers: list[float]) -> None:
    found = percentiles(counted(numbers), (0, 50, 95, 99, 100), max(numbers))
    exact = np.percentile(numbers, (0, 50, 95, 99, 100))
    np.testing.assert_allclose(found, exact, rtol=ACCURACY * 1.0001, atol=1e-12)


def test_what_lies_beyond_the_bins_counts_as_the_largest() -> None:
    assert percentiles(counted([1.0, 3e14, 1e15]), (50, 100), 1e15) == [1e15, 1e15]


def made(seed: int, keys: Sequence[Key] = (ONE, OTHER), n: int = 5000) -> Histograms:
    rng = np.random.default_rng(seed)
    histograms = Histograms()
    histograms.add(keys, rng.integers(0, len(keys), n), 10 ** rng.normal(-1, 1, n))
    return histograms


def same(a: Sketch, b: Sketch) -> bool:
    columns = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("edges", "bin", "count"))
    return a.keys == b.keys and columns


def test_histograms_add_up_in_any_order() -> None:
    parts = [made(seed, keys).sketch(lambda key: key) for seed, keys in enumerate([(ONE,), (OTHER, ONE), (OTHER,)])]
    sums = []
    for order in ((0, 1, 2), (2, 0, 1)):
        whole = Histograms()
        for i in order:
            whole.join(parts[i])
        sums.append(whole.sketch())
    assert same(*sums)
    assert sums[0].count.sum() == 15_000
    of_one = sums[0].total(lambda key: key == ONE)
    np.testing.assert_array_equal(of_one, sum(part.total(lambda key: key == ONE) for part in parts))


def test_methods_that_are_not_asked_for_are_left_out() -> None:
    assert made(1).sketch(lambda key: key, ["fusion"]).keys == (OTHER,)


def test_a_file_holds_the_same(tmp_path: Path) -> None:
    for i, sketch in enumerate((made(1).sketch(lambda key: key), Histograms().sketch())):
        sketch.write(tmp_path / f"{i}.parquet")
        assert same(Sketch.read(tmp_path / f"{i}.parquet"), sketch)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "percentiles.parquet"
    with pytest.raises(EgolocError, match=r"percentiles\.parquet: missing: expected a run folder"):
        Sketch.read(path)
    made(1).sketch(lambda key: key).write(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(EgolocError, match=r"percentiles\.parquet: expected a Parquet file"):
        Sketch.read(path)
