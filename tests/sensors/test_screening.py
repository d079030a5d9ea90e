"""Which stamps of a source are kept."""

from itertools import combinations, pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sensors.records import LeftOut
from sensors.screening import APART_NS, JUMP_NS, Carry, judge, screen

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


def judged(stamps: list[int], carry: Carry, arrivals: list[int] | None = None) -> list[str]:
    """The reason of each row, "" where it is kept; arrivals default to the stamps."""
    t_ns = np.array(stamps, np.int64)
    verdict = judge(t_ns, t_ns if arrivals is None else np.array(arrivals, np.int64), {}, carry)
    return ["" if code == 0 else verdict.reasons[code - 1] for code in verdict.code.tolist()]


@given(st.lists(st.integers(0, 8), max_size=9), st.integers(-1, 9))
def test_stamps_go_on_from_the_last_one_kept(stamps: list[int], last: int) -> None:
    reasons = judged(stamps, Carry(last_ns=last))
    chosen = [t for t, reason in zip(stamps, reasons, strict=True) if not reason]
    assert all(a < b for a, b in pairwise([last, *chosen]))
    above = [t for t in stamps if t > last]
    longest = max((n for n in range(len(above) + 1) for c in combinations(above, n) if all(np.diff(c) > 0)), default=0)
    assert len(chosen) == longest


def test_what_comes_too_late_is_told_from_what_goes_back() -> None:
    back, late = "stamp goes back", "message comes too late, after others of its time were passed on"
    assert judged([3, 5, 9, 10, 11], Carry(last_ns=4, floor_ns=10)) == [back, late, late, "", ""]


def test_a_jump_is_one_from_the_usual_offset() -> None:
    carry = Carry(offset_ns=0.0)
    far = JUMP_NS + 1
    stamps = [k * SECOND for k in range(30)]
    jump = "stamp jumps away from its arrival"
    one = [*stamps[:4], stamps[4] + far, *stamps[5:]]
    assert judged(one, carry, stamps) == [jump if k == 4 else "" for k in range(30)]
    most = [t + far if 2 <= k < 28 else t for k, t in enumerate(stamps)]
    assert judged(most, carry, stamps) == [jump if 2 <= k < 28 else "" for k in range(30)]


def test_a_clock_that_was_set_is_followed_once_it_stays() -> None:
    carry, stamps = Carry(offset_ns=0.0), [k * SECOND for k in range(30)]
    ahead = [t + 2 * JUMP_NS if k >= 15 else t for k, t in enumerate(stamps)]
    assert judged(ahead, carry, stamps) == [""] * 30
    too_short = [t + 2 * JUMP_NS if k >= 25 else t for k, t in enumerate(stamps)]
    assert judged(too_short, carry, stamps) == [""] * 25 + ["stamp jumps away from its arrival"] * 5
    assert judged([t + 2 * JUMP_NS for t in stamps], carry, stamps) == [""] * 30
    assert judged([t + 2 * JUMP_NS for t in stamps], carry, [0] * 30) == [""] * 30


def test_only_what_goes_on_from_the_newest_stamp_is_kept() -> None:
    apart = "stamp lies an hour or more apart from most others"
    later = [APART_NS + k for k in range(5)]
    assert judged(later, Carry(alive_ns=0)) == [apart] * 5
    assert judged(later, Carry(alive_ns=1)) == [apart if t - 1 >= APART_NS else "" for t in later[:1]] * 5
    assert judged([5, *later], Carry(alive_ns=0)) == ["", *[""] * 5]
    assert judged([5, 2 * APART_NS, 2 * APART_NS + 1], Carry(alive_ns=0)) == ["", apart, apart]
