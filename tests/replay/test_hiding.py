"""GNSS hidden in stretches, and what becomes of it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusion.result import Sensor
from replay.config import HideGnss
from replay.hiding import Hider, horizontal_sigma, stretch_index
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.pieces import cut, join
from sensors.records import GnssFix, GnssStatus, Log
from sensors.vehicle import Vehicle
from tests.replay.drives import FRAME, START_NS, decisions, drive, gnss_velocity, stamps

S = 1_000_000_000


def gnss_of(log: Log) -> GnssFix:
    assert log.gnss is not None
    return log.gnss


def hidden_of(log: Log, hide: HideGnss, piece_s: float = 1e6) -> tuple[Log, Hider]:
    """What the filter gets of a log, cut into pieces, and who hid the rest."""
    hider = Hider(hide, log.vehicle)
    given = join(hider.hide(piece) for piece in cut(log, piece_s))
    hider.close()
    return given, hider


def used_s(hider: Hider) -> list[list[float]]:
    """Start and end of the stretches that are used, s since the first fix."""
    return ((hider.stretches() - START_NS) / S).tolist()


@pytest.mark.parametrize("piece_s", [1e6, 40.0, 1.0])
def test_the_first_stretch_follows_one_period_without_and_the_last_is_complete(piece_s: float) -> None:
    hide = HideGnss(60, 15)
    for duration_s, last in ((200.0, [180, 195]), (195.1, [180, 195]), (195.0, [120, 135])):
        log, _ = drive(duration_s, with_reference=False)
        given, hider = hidden_of(log, hide, piece_s)
        assert used_s(hider)[0] == [60, 75]
        assert used_s(hider)[-1] == last
        seconds = (gnss_of(given).t_ns - START_NS) / S
        assert not ((seconds >= 180) & (seconds < 195)).any(), "it is hidden even where the log ends within it"


@pytest.mark.parametrize(
    ("again_s", "starts"),
    [
        (500.0, range(60, 1200, 60)),
        (800.0, [60, *range(240, 1200, 60)]),  # the fix after 135 and 195 s comes more than 600 s later
        (2000.0, [60]),
    ],
)
def test_a_stretch_is_not_used_where_no_fix_returns_for_long(again_s: float, starts: Any) -> None:
    log, _ = drive(1200.0, with_reference=False)
    since = (gnss_of(log).t_ns - START_NS) / S
    kept = gnss_of(log)[(since < 100) | (since > again_s)]
    for piece_s in (1e6, 30.0):
        _, hider = hidden_of(replace(log, gnss=kept), HideGnss(60, 15), piece_s)
        assert [start for start, _ in used_s(hider)] == list(starts)


def test_stretches_hold_their_start_but_not_their_end() -> None:
    stretches = np.array([[10, 20], [30, 40]])
    assert stretch_index(np.array([9, 10, 19, 20, 29, 30, 39, 40]), stretches).tolist() == [-1, 0, 0, -1, -1, 1, 1, -1]
    assert stretch_index(np.array([5]), np.empty((0, 2), np.int64)).tolist() == [-1]


def test_positions_and_velocities_in_the_stretch_are_taken_out() -> None:
    log, _ = drive(100.0, with_reference=False)
    log = replace(log, gnss_velocity=gnss_velocity(stamps(100.0, 5.0)))
    given, hider = hidden_of(log, HideGnss(60, 15), 30.0)
    for record, hz in ((given.gnss, 10), (given.gnss_velocity, 5)):
        assert record is not None
        seconds = (record.t_ns - START_NS) / S
        assert not ((seconds >= 60) & (seconds < 75)).any()
        assert len(record) == 85 * hz
    assert len(gnss_of(log)) == 1000  # nothing was changed in place
    made = decisions(given)
    rows = hider.original_rows(made)
    assert log.gnss_velocity is not None
    for sensor, original in ((Sensor.GNSS_POSITION, gnss_of(log)), (Sensor.GNSS_VELOCITY, log.gnss_velocity)):
        here = made.sensor == sensor
        np.testing.assert_array_equal(original.t_ns[rows[here]], made.t_ns[here])


def test_the_reference_is_the_antenna_at_its_fixed_fixes_when_these_were_true() -> None:
    log, _ = drive(100.0, with_reference=False, vehicle=Vehicle(gnss_delay_s=0.2))
    status = np.full(1000, GnssStatus.FIXED, np.int8)
    status[650] = GnssStatus.FLOAT
    fixes = replace(gnss_of(log), status=status)
    given, hider = hidden_of(replace(log, gnss=fixes), HideGnss(60, 15))
    reference = given.reference
    assert reference is not None
    assert len(reference) == 999
    assert reference.t_ns[0] == START_NS - S // 5
    np.testing.assert_allclose(reference.p_map[0], map_from_llh(FRAME, fixes.llh[:1])[0], atol=1e-6)
    np.testing.assert_allclose(reference.sigma[:, 0], 0.01)
    assert hider.stretches().tolist() == [[START_NS + 60 * S - S // 5, START_NS + 75 * S - S // 5]]


def test_no_velocity_of_another_delay_reaches_into_a_stretch() -> None:
    vehicle = Vehicle(gnss_delay_s=-0.26, gnss_velocity_delay_s=-0.13)
    log, _ = drive(100.0, with_reference=False, vehicle=vehicle)
    log = replace(log, gnss_velocity=gnss_velocity(stamps(100.0, 10.0)))
    given, hider = hidden_of(log, HideGnss(60, 15), 7.0)
    assert given.gnss_velocity is not None
    true_ns = given.gnss_velocity.t_ns + round(0.13 * S)
    start, end = hider.stretches()[0]
    assert not ((true_ns >= start) & (true_ns < end)).any()
    assert len(true_ns) == 1000 - 150


def test_worst_horizontal_direction() -> None:
    cov = np.array([[[5.0, 4.0, 0.0], [4.0, 5.0, 0.0], [0.0, 0.0, 100.0]]])  # eigenvalues 9 and 1
    assert horizontal_sigma(cov) == pytest.approx([3.0])


def test_without_fixed_fixes_there_is_nothing_to_compare_with() -> None:
    log, _ = drive(100.0)
    floating = replace(gnss_of(log), status=np.full(1000, GnssStatus.FLOAT, np.int8))
    for given in (replace(log, gnss=None), replace(log, gnss=floating)):
        with pytest.raises(EgolocError, match="expected GNSS fixes of status fixed"):
            hidden_of(given, HideGnss(60, 15))


def test_a_log_too_short_for_one_stretch() -> None:
    log, _ = drive(70.0)
    with pytest.raises(EgolocError, match=r"expected at least 75 s of GNSS and IMU for one stretch, found 69\.9 s"):
        hidden_of(log, HideGnss(60, 15))
