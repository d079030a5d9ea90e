"""GNSS hidden in stretches, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.result import Sensor
from replay.config import HideGnss
from replay.hiding import hide_gnss, horizontal_sigma, plan_stretches, stretch_index
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.records import GnssFix, GnssStatus, Log
from sensors.vehicle import Vehicle
from tests.replay.drives import FRAME, START_NS, drive, gnss_velocity, stamps

S = 1_000_000_000


def gnss_of(log: Log) -> GnssFix:
    assert log.gnss is not None
    return log.gnss


def test_the_first_stretch_follows_one_period_without_and_the_last_is_complete() -> None:
    assert plan_stretches(0, 200 * S, HideGnss(60, 15)).tolist() == [
        [60 * S, 75 * S],
        [120 * S, 135 * S],
        [180 * S, 195 * S],
    ]
    assert plan_stretches(0, 195 * S, HideGnss(60, 15))[-1].tolist() == [180 * S, 195 * S]
    assert plan_stretches(0, 195 * S - 1, HideGnss(60, 15))[-1].tolist() == [120 * S, 135 * S]
    assert len(plan_stretches(0, 74 * S, HideGnss(60, 15))) == 0


def test_stretches_hold_their_start_but_not_their_end() -> None:
    stretches = np.array([[10, 20], [30, 40]])
    assert stretch_index(np.array([9, 10, 19, 20, 29, 30, 39, 40]), stretches).tolist() == [-1, 0, 0, -1, -1, 1, 1, -1]
    assert stretch_index(np.array([5]), np.empty((0, 2), np.int64)).tolist() == [-1]


def test_positions_and_velocities_in_the_stretch_are_taken_out() -> None:
    log, _ = drive(100.0, with_reference=False)
    log = replace(log, gnss_velocity=gnss_velocity(stamps(100.0, 5.0)))
    hidden = hide_gnss(log, HideGnss(60, 15))
    for record, hz in ((hidden.log.gnss, 10), (hidden.log.gnss_velocity, 5)):
        assert record is not None
        seconds = (record.t_ns - START_NS) / S
        assert not ((seconds >= 60) & (seconds < 75)).any()
        assert len(record) == 85 * hz
    assert len(gnss_of(log)) == 1000  # nothing was changed in place
    kept = hidden.rows[Sensor.GNSS_POSITION]
    np.testing.assert_array_equal(gnss_of(log).t_ns[kept], gnss_of(hidden.log).t_ns)


def test_the_reference_is_the_antenna_at_its_fixed_fixes_when_these_were_true() -> None:
    log, _ = drive(100.0, with_reference=False, vehicle=Vehicle(gnss_delay_s=0.2))
    status = np.full(1000, GnssStatus.FIXED, np.int8)
    status[650] = GnssStatus.FLOAT
    fixes = replace(gnss_of(log), status=status)
    hidden = hide_gnss(replace(log, gnss=fixes), HideGnss(60, 15))
    reference = hidden.log.reference
    assert reference is not None
    assert len(reference) == 999
    assert reference.t_ns[0] == START_NS - S // 5
    np.testing.assert_allclose(reference.p_map[0], map_from_llh(FRAME, fixes.llh[:1])[0], atol=1e-6)
    np.testing.assert_allclose(reference.sigma[:, 0], 0.01)
    assert hidden.stretches.tolist() == [[START_NS + 60 * S - S // 5, START_NS + 75 * S - S // 5]]


def test_no_velocity_of_another_delay_reaches_into_a_stretch() -> None:
    vehicle = Vehicle(gnss_delay_s=-0.26, gnss_velocity_delay_s=-0.13)
    log, _ = drive(100.0, with_reference=False, vehicle=vehicle)
    hidden = hide_gnss(replace(log, gnss_velocity=gnss_velocity(stamps(100.0, 10.0))), HideGnss(60, 15))
    assert hidden.log.gnss_velocity is not None
    true_ns = hidden.log.gnss_velocity.t_ns + round(0.13 * S)
    start, end = hidden.stretches[0]
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
            hide_gnss(given, HideGnss(60, 15))


def test_a_log_too_short_for_one_stretch() -> None:
    log, _ = drive(70.0)
    with pytest.raises(EgolocError, match=r"expected at least 75 s of GNSS and IMU for one stretch, found 69\.9 s"):
        hide_gnss(log, HideGnss(60, 15))
