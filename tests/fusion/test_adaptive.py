"""Noise of known shares, times and lengths found again by the filter's own likelihood."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.adaptive import GNSS, Sought, applied_only, estimate, open_to_all, with_values
from fusion.config import FusionConfig
from fusion.result import Sensor
from fusion.run import run
from replay.bench.consistency import BLOCKS, nees
from sensors.errors import EgolocError
from sensors.records import Log
from sensors.simulate.drive import Drive, simulate, simulate_drive
from sensors.simulate.scenarios import load

TRUTH = {
    "imu.noise_scale": 1.0,
    "gnss.inflation": 1.0,
    "gnss.velocity_inflation": 1.0,
    "pose.inflation": 1.0,
}


def lasting(seed: int, duration_s: float, share: float, lasts_s: float, placed: float, length_m: float) -> Log:
    """A drive of the clean scenario; shares of the variance of GNSS (in time) and pose fixes (along the road) last."""
    scenario = load("clean")
    gnss = msgspec.structs.replace(scenario.gnss, correlated_fraction=share, correlation_s=lasts_s)
    pose = msgspec.structs.replace(scenario.pose_fix, feature_fraction=placed, feature_scale_m=length_m)
    wheel = msgspec.structs.replace(scenario.wheel, use=False)
    return simulate(duration_s, seed, msgspec.structs.replace(scenario, gnss=gnss, pose_fix=pose, wheel=wheel))


def test_what_lasts_10_s_and_100_m_is_found() -> None:
    """Ten minutes hold 60 of these times and lengths. Every number within its 95 % interval widened by half (eight of
    them at once), which is narrow enough to say something; afterwards innovations are white and as large as stated."""
    found = estimate(lasting(3, 600.0, 0.5, 10.0, 0.5, 100.0))
    truth = TRUTH | {
        "gnss.lasting_share": 0.5,
        "gnss.lasting_s": 10.0,
        "pose.lasting_share": 0.5,
        "pose.lasting_m": 100.0,
    }
    assert set(found.found) == set(truth)
    for name, value in truth.items():
        each = found.found[name]
        assert each.observed, name
        assert abs(np.log(each.value / value)) < 1.5 * np.log(each.high / each.low) / 2.0, name
    assert found.found["pose.lasting_m"].value == pytest.approx(100.0, rel=0.4)
    assert found.found["gnss.lasting_s"].value == pytest.approx(10.0, rel=0.5)
    assert found.found["gnss.lasting_share"].value == pytest.approx(0.5, abs=0.15)
    assert found.found["pose.lasting_share"].value == pytest.approx(0.5, abs=0.12)
    assert found.gain > 1000.0
    for axis in found.after:
        if axis.sensor in (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY, Sensor.POSE_FIX):
            assert axis.factor == pytest.approx(1.0, abs=0.08), axis
            assert axis.share < 0.05, axis
    assert found.config.gnss.inflation == found.found["gnss.inflation"].value
    assert with_values(found.config, {"gnss.inflation": 4.0}).gates == FusionConfig().gates


@pytest.mark.slow
def test_what_lasts_30_s_and_300_m_is_found_in_eight_drives() -> None:
    """Ten minutes hold twenty such times and lengths: rough figures, and intervals that know it. Prints the ranges."""
    lasts = {"gnss.lasting_share": 0.7, "gnss.lasting_s": 30.0, "pose.lasting_share": 0.7, "pose.lasting_m": 300.0}
    truth = TRUTH | lasts
    drives = [estimate(lasting(seed, 600.0, 0.7, 30.0, 0.7, 300.0)).found for seed in range(1, 9)]
    hits = 0
    for name, value in truth.items():
        found = [drive[name] for drive in drives]
        hits += sum(each.low <= value <= each.high for each in found)
        print(f"{name}: {min(f.value for f in found):.3g} to {max(f.value for f in found):.3g}, truth {value:g}")
        assert np.exp(np.mean([np.log(f.value / value) for f in found])) == pytest.approx(1.0, abs=0.4), name
    print(f"{hits} of {len(drives) * len(truth)} inside their 95 % intervals")
    assert hits >= 0.85 * len(drives) * len(truth)


@pytest.mark.slow
def test_where_nothing_lasts_no_time_is_claimed() -> None:
    found = estimate(lasting(4, 200.0, 0.0, 30.0, 0.0, 300.0))
    for name in ("gnss.lasting_share", "pose.lasting_share"):
        assert found.found[name].low < 0.05, name
        assert found.found[name].value < 0.2, name
    for name in ("gnss.inflation", "pose.inflation", "gnss.velocity_inflation"):
        assert found.found[name].value == pytest.approx(1.0, abs=0.15), name
    assert found.gain < 10.0


def test_rejected_measurements_are_left_out_and_the_rest_is_all_applied() -> None:
    scenario = load("demo")
    log = simulate(300.0, 1, scenario)
    first = run(log)
    kept = applied_only(log, first.decisions)
    assert kept.pose_fixes is not None
    assert log.pose_fixes is not None
    assert len(kept.pose_fixes) < len(log.pose_fixes)
    again = run(kept, open_to_all(FusionConfig())).decisions
    for sensor in (Sensor.GNSS_POSITION, Sensor.POSE_FIX, Sensor.WHEEL):
        decided = again.reason[(again.sensor == sensor) & (again.t_ns > (first.aligned_ns or 0))]
        assert (decided == 0).all(), sensor


@pytest.mark.parametrize("value", [0.02, 0.3, 0.94])
def test_scales_of_the_search_come_back(value: float) -> None:
    share, time = GNSS[1], GNSS[2]
    assert share.outward(share.inward(value)) == pytest.approx(value)
    assert time.outward(time.inward(100 * value)) == pytest.approx(100 * value)
    assert share.outward(50.0) == share.high
    assert share.outward(-50.0) == share.low
    assert Sought("a", "b", 1.0, 0.5, 2.0).name == "a.b"


def test_a_drive_without_fixes_is_refused() -> None:
    log = simulate(60.0, 1, load("clean"))
    with pytest.raises(EgolocError, match="a drive on which the filter aligns"):
        estimate(Log(imu=log.imu, wheel=log.wheel, vehicle=log.vehicle, map_frame=log.map_frame))


@pytest.mark.slow
def test_what_is_found_makes_the_filter_honest_on_other_drives() -> None:
    """GNSS twice as bad as stated, nine tenths of it for two minutes: replayed with what one drive shows, the NEES of
    others come nearer to one. Prints them."""
    scenario = load("clean")
    gnss = msgspec.structs.replace(scenario.gnss, correlated_fraction=0.9, correlation_s=120.0)
    strange = msgspec.structs.replace(scenario, gnss=gnss)
    found = estimate(modest(simulate_drive(900.0, 100_001, strange)).log).config
    given = FusionConfig()
    print(found.gnss, found.pose, found.imu)
    drives = [modest(simulate_drive(300.0, 100_010 + k, strange)) for k in range(8)]
    judged = [[nees(drive, config) for drive in drives] for config in (given, found)]
    for block in ("position", "velocity", "attitude", "horizontal pose"):
        before, after = (np.nanmean([scores[block] for scores in each]) for each in judged)
        dof = len(BLOCKS[block])
        print(f"{block}: NEES/dof {before / dof:.2f} by default, {after / dof:.2f} with what was found")
        assert abs(np.log(after / dof)) < abs(np.log(before / dof)), block


def modest(drive: Drive) -> Drive:
    """The drive with GNSS positions whose covariance is stated half as large as it is."""
    assert drive.log.gnss is not None
    return replace(drive, log=replace(drive.log, gnss=replace(drive.log.gnss, cov_enu=drive.log.gnss.cov_enu / 2.0)))
