"""Rates and gaps of stamps that come in stretches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors import steps
from sensors.steps import Steps


def of(t_ns: list[int], parts: int = 1) -> Steps:
    found = Steps()
    for part in np.array_split(np.array(t_ns, np.int64), parts):
        found.add(part)
    return found


@given(st.lists(st.integers(0, 10**18), min_size=2, max_size=30, unique=True), st.integers(1, 40))
def test_stretches_count_as_one(stamps: list[int], parts: int) -> None:
    t_ns = sorted(stamps)
    found, lengths = of(t_ns, parts), np.diff(t_ns)
    assert (found.count, found.first_ns, found.last_ns) == (len(t_ns), t_ns[0], t_ns[-1])
    assert found.longest_ns == lengths.max()
    assert found.median_ns() == np.median(lengths)
    middle = int(np.median(lengths))
    assert found.above(middle) == int((lengths > middle).sum())


def test_nothing_and_one() -> None:
    for found in (Steps(), of([]), of([5])):
        assert (found.median_ns(), found.rate_hz(), found.longest_ns, found.above(0)) == (None, None, None, 0)
    assert of([5]).count == 1
    assert of([7, 7]).rate_hz() is None
    assert of([0, 10_000_000, 20_000_000]).rate_hz() == 100.0


def test_many_different_steps_are_told_apart_to_four_per_mille(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "DISTINCT", 1000)
    lengths = np.random.default_rng(2).integers(9_000_000, 11_000_000, 200_000)
    found = of(np.cumsum(lengths).tolist(), 50)
    assert len(found._lengths) < 2000
    median = found.median_ns()
    assert median == pytest.approx(np.median(lengths[1:]), rel=0.004)
    assert found.longest_ns == lengths[1:].max()
    assert found.count == 200_000
