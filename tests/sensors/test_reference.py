"""Kernels read the same from a named tuple and from a reference to it, and write into the same arrays."""

from typing import NamedTuple

import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.typing import NDArray

from sensors.kernel import kernel
from sensors.reference import by_reference


class Limits(NamedTuple):
    """All of one type: laid out as an array."""

    least: float
    most: float


class Inner(NamedTuple):
    """A flag before numbers: the compiler leaves room between them."""

    flag: bool
    limits: Limits
    count: int


class Outer(NamedTuple):
    """Arrays of several kinds around a tuple, with a tuple of numbers."""

    on: bool
    values: NDArray[np.float64]
    inner: Inner
    codes: NDArray[np.int8]
    point: tuple[float, float, float]
    table: NDArray[np.float64]


def _outer() -> Outer:
    codes = np.array([3, 4], np.int8)
    return Outer(
        True, np.array([1.0, 2.0]), Inner(True, Limits(-2.5, 7.5), 11), codes, (5.0, 6.0, 7.0), np.eye(2) * 9.0
    )


@kernel()
def _read_all(outer: Outer, found: NDArray[np.float64]) -> None:
    inner = outer.inner
    found[0], found[1], found[2] = int(outer.on), outer.values[1], int(inner.flag)
    found[3], found[4], found[5] = inner.limits.least, inner.limits.most, inner.count
    found[6], found[7], found[8] = outer.codes[1], outer.point[2], outer.table[1, 1]


@kernel()
def _write(outer: Outer) -> None:
    outer.values[0] = 40.0
    outer.codes[:] = 7


@kernel()
def _referring(outer: Outer, found: NDArray[np.float64]) -> None:
    outer = by_reference(by_reference(outer))
    _read_all(outer, found)
    _write(outer)


@kernel()
def _refer_in_a_loop(values: NDArray[np.float64], found: NDArray[np.float64]) -> None:
    for i in range(len(values)):
        limits = by_reference(Limits(values[i], -values[i]))
        found[i] = limits.least - limits.most


@kernel()
def _read_what_is_not_there(outer: Outer) -> float:
    return float(by_reference(outer).nothing)


@kernel()
def _refer_to_a_number(x: float) -> float:
    return float(by_reference(x))


_EXPECTED = [1.0, 2.0, 1.0, -2.5, 7.5, 11.0, 4.0, 7.0, 9.0]


def test_fields_read_the_same_by_value_and_by_reference() -> None:
    by_value, referred = np.zeros(9), np.zeros(9)
    _read_all(_outer(), by_value)
    _referring(_outer(), referred)
    assert by_value.tolist() == referred.tolist() == _EXPECTED


def test_plain_python_reads_the_tuple_itself() -> None:
    outer = _outer()
    assert by_reference(outer) is outer


def test_arrays_of_the_caller_are_written() -> None:
    outer = _outer()
    _referring(outer, np.zeros(9))
    assert outer.values.tolist() == [40.0, 2.0]
    assert outer.codes.tolist() == [7, 7]


def test_arrays_of_another_kind_make_another_reference() -> None:
    read_only = _outer().values
    read_only.flags.writeable = False
    found = np.zeros(9)
    with pytest.raises(TypingError):  # the kernel writes into them
        _referring(_outer()._replace(values=read_only), found)
    strided = np.array([[1.0, 0.0], [2.0, 0.0]])[:, 0]
    _referring(_outer()._replace(values=strided), found)
    assert found.tolist() == _EXPECTED
    assert strided.tolist() == [40.0, 2.0]


def test_a_reference_in_a_loop_is_to_the_tuple_of_the_turn() -> None:
    found = np.zeros(3)
    _refer_in_a_loop(np.array([1.0, 2.0, 3.0]), found)
    assert found.tolist() == [2.0, 4.0, 6.0]


def test_only_named_tuples_and_their_fields() -> None:
    with pytest.raises(TypingError, match="nothing"):
        _read_what_is_not_there(_outer())
    with pytest.raises(TypingError):
        _refer_to_a_number(1.0)
