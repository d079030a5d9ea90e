"""Values that kernels read by address are the ones that were given."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.held import Held, refer
from sensors.kernel import kernel


class Inner(NamedTuple):
    row: NDArray[np.float64]
    count: int


class Outer(NamedTuple):
    inner: Inner
    sizes: tuple[float, bool]
    codes: NDArray[np.int8]


@kernel()
def _summed(held: Held[Outer], factor: float) -> float:
    outer = refer(held)
    outer.inner.row[0] += factor
    total: float = outer.inner.row.sum() + outer.inner.count + outer.sizes[0] + outer.sizes[1] + outer.codes[-1]
    return total


def _outer(numbers: list[float]) -> Outer:
    return Outer(Inner(np.array(numbers), 10), (0.5, True), np.array([7, -3], np.int8))


def test_a_kernel_reads_and_writes_what_is_held() -> None:
    given = _outer([1.0, 2.0])
    held = Held(given)
    assert _summed(held, 4.0) == 1.0 + 2.0 + 4.0 + 10 + 0.5 + 1 - 3
    assert given.inner.row.tolist() == [5.0, 2.0]
    given.inner.row[1] = 100.0
    assert _summed(held, 0.0) == 105.0 + 10 + 0.5 + 1 - 3


def test_many_of_one_type_are_kept_apart() -> None:
    every = [Held(_outer([float(k)])) for k in range(50)]
    assert [_summed(held, 0.0) for held in every] == [k + 8.5 for k in range(50)]
    assert len({held.numba_type for held in every}) == 1


def test_a_held_value_outlives_the_name_it_was_given_by() -> None:
    held = Held(_outer([3.0] * 1000))
    rubbish = [np.full(1000, 9.0) for _ in range(100)]
    assert len(rubbish) == 100
    assert _summed(held, 0.0) == 3008.5


def test_another_type_is_read_as_what_it_is() -> None:
    other = Outer(Inner(np.arange(4)[::-1], 2), (0.25, False), np.array([1], np.int8))  # type: ignore[arg-type]
    assert _summed(Held(other), 1.0) == 7 + 2 + 0.25 + 1
