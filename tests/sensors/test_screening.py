"""Which stamps of a source are kept."""

from itertools import combinations, pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sensors.records import LeftOut
from sensors.screening import APART_NS, JUMP_NS, screen

SECOND = 10**9


def kept(stamps: list[int], arrivals: list[int] | None = None) -> tuple[list[int], dict[str, int]]:
    """Rows that are kept and reasons of the others; arrivals default to none at all (all zero)."""
    t_ns = np.array(stamps, np.int64)
    arrival_ns = np.zeros_like(t_ns) if arrivals is None else np.array(arrivals, np.int64)
    keep, left_out = screen("x", t_ns, arrival_ns, {})
    assert sum(row.count for row in left_out) == int((~keep).sum())
    return np.flatnonzero(keep).tolist(), {row.reason: row.count for row in left_out}


@given(st.lists(st.integers(0, 8), max_size=9))
def test_as_many_rows_as_can_increase_are_kept(stamps: list[int]) -> None:
    rows, _ = kept(stamps)
    chosen = [stamps[row] for row in rows]
    assert all(a < b for a, b in pairwise(chosen))
    longest = max(
        (n for n in range(len(stamps) + 1) for c in combinations(stamps, n) if all(np.diff(c) > 0)), default=0
    )
    assert len(rows) == longest


def test_one_stray_stamp_costs_one_row() -> None:
    assert kept([0, 1, 2, 9, 4, 5, 6]) == ([0, 1, 2, 4, 5, 6], {"stamp runs ahead of those that follow": 1})
    assert kept([0, 1, 2, -5, 4, 5]) == ([0, 1, 2, 4, 5], {"stamp goes back": 1})
    assert kept([0, 1, 1, 2, 2, 2]) == ([0, 1, 3], {"stamp repeats": 3})
    assert kept([3, 2, 1]) == ([0], {"stamp goes back": 2})
    assert kept([]) == ([], {})


def test_a_stamp_far_from_its_arrival_has_jumped() -> None:
    stamps = [k * SECOND for k in range(10)]
    late = [*stamps[:9], stamps[9] + JUMP_NS + 1]
    assert kept(late, stamps) == (list(range(9)), {"stamp jumps away from its arrival": 1})
    assert kept([*stamps[:9], stamps[9] + JUMP_NS], stamps)[1] == {}


def test_arrivals_that_would_condemn_half_of_the_rows_are_not_asked() -> None:
    stamps = [k * 10 * SECOND for k in range(20)]
    assert kept(stamps, [7] * 20)[1] == {}
    assert kept(stamps, [2 * t for t in stamps])[1] == {}
    half = [t + (100 * SECOND if t >= stamps[10] else 0) for t in stamps]
    assert kept(half, stamps)[1] == {}
    most = [t + (100 * SECOND if t >= stamps[11] else 0) for t in stamps]
    assert kept(most, stamps) == (list(range(11)), {"stamp jumps away from its arrival": 9})


def test_the_largest_part_of_a_source_in_pieces_is_kept() -> None:
    pieces = [0, 1, APART_NS + 1, APART_NS + 2, APART_NS + 3, 3 * APART_NS]
    reason = "stamp lies an hour or more apart from most others"
    assert kept(pieces, pieces) == ([2, 3, 4], {reason: 3})
    assert kept([0, APART_NS - 1], [0, APART_NS - 1])[1] == {}


def test_bad_rows_come_first_and_do_not_count_as_stamps() -> None:
    t_ns = np.array([0, 10**18, 1, 2])
    passes = np.array([True, False, True, True])
    keep, left_out = screen("x", t_ns, t_ns, {"gyro is not finite": passes})
    assert keep.tolist() == passes.tolist()
    assert left_out == (LeftOut("x", "gyro is not finite", 1),)
