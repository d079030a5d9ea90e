"""Tables and metrics of made-up results whose errors are known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusion.result import FusionResult
from replay.config import LIMITS, HideGnss, Limits, RunConfig
from replay.metrics import metrics_of
from sensors.records import GnssStatus, Log
from sensors.vehicle import Vehicle
from tests.replay.assembling import Assembled, assemble
from tests.replay.drives import START_NS, decisions, drive, gnss, reference, stamps, states, to_map, track

S = 1_000_000_000
ERROR = (0.05, -0.02, 0.002)


def replayed(log: Log, result: FusionResult, **config: Any) -> Assembled:
    return assemble(log, RunConfig(**config), result)


def test_constant_errors_come_out_on_their_axes() -> None:
    metrics = replayed(*drive(60.0, state_error=ERROR, pose_error=(0.12, 0.35, -0.005))).metrics
    fusion, egovm, gnss_row = (metrics["methods"][name] for name in ("fusion", "egovm", "gnss"))
    assert fusion["lon"]["mae"] == pytest.approx(0.05, abs=1e-6)
    assert fusion["lat"]["max"] == pytest.approx(0.02, abs=1e-6)
    assert fusion["yaw"]["rmse"] == pytest.approx(np.degrees(0.002), rel=1e-6)
    assert fusion["ar"] == fusion["coverage"] == 1.0
    assert egovm["ar"] == 0.0
    assert egovm["lat"]["below"] == {"0.1": 0.0, "0.2": 0.0, "0.3": 0.0}
    assert egovm["yaw"]["mae"] == pytest.approx(np.degrees(0.005), rel=1e-6)
    assert gnss_row["ar"] == 1.0
    assert gnss_row["yaw"] is None
    assert metrics["duration_s"] == pytest.approx(59.9)
    assert metrics["epochs"] == 599
    assert metrics["distance_m"] == pytest.approx(599, rel=1e-3)
    assert metrics["excluded"] == {}


def test_errors_are_estimate_minus_reference_along_and_left() -> None:
    run = replayed(*drive(60.0, state_error=ERROR, pose_error=(0.1, 0.3, -0.01)))
    for name, expected in zip(("err_lon", "err_lat", "err_yaw"), ERROR, strict=True):
        np.testing.assert_allclose(run.states[name], expected, atol=1e-6)
    fixes = run.decisions["sensor"] == 3
    np.testing.assert_allclose(run.decisions["err_lat"][fixes], 0.3, atol=1e-6)


def test_the_time_before_alignment_is_unavailable() -> None:
    metrics = replayed(*drive(60.0, aligned_s=15.0)).metrics
    fusion = metrics["methods"]["fusion"]
    assert fusion["coverage"] == fusion["ar"] == pytest.approx(45.0 / 59.9)
    assert metrics["alignment_s"] == 15.0


def test_a_filter_that_never_aligns_is_never_available() -> None:
    done = replayed(*drive(60.0, aligned_s=99.0))
    assert done.metrics["methods"]["fusion"] == {
        "ar": 0.0,
        "ar_distance": 0.0,
        "coverage": 0.0,
        "lon": None,
        "lat": None,
        "yaw": None,
    }
    assert done.metrics["alignment_s"] is None
    assert len(done.states["t_ns"]) == 600
    assert np.isnan(done.states["x"]).all()


def test_an_outage_open_at_the_end_counts() -> None:
    log, result = drive(60.0)
    metrics = replayed(log, replace(result, states=states(stamps(45.0, 10.0)))).metrics
    assert metrics["methods"]["fusion"]["ar"] == pytest.approx(44.9 / 59.9)


def test_a_diverged_state_is_no_output() -> None:
    log, result = drive(60.0)
    llh = result.states.llh.copy()
    llh[100:200] = np.nan
    metrics = replayed(log, replace(result, states=replace(result.states, llh=llh))).metrics
    assert metrics["methods"]["fusion"]["coverage"] == pytest.approx(49.9 / 59.9)


def test_lost_fixes_cover_one_and_a_half_periods_at_most() -> None:
    log, result = drive(60.0)
    kept = np.r_[0:100, 300:600]  # 20.1 s between two fixes, of which 0.15 s count
    assert log.gnss is not None
    log = replace(log, gnss=log.gnss[kept])
    metrics = replayed(log, replace(result, decisions=decisions(log))).metrics
    assert metrics["methods"]["gnss"]["coverage"] == pytest.approx((9.9 + 0.15 + 29.9) / 59.9)


def test_a_fix_without_solution_is_no_output() -> None:
    log, result = drive(60.0)
    assert log.gnss is not None
    status = log.gnss.status.copy()
    status[200:300] = GnssStatus.NONE
    metrics = replayed(replace(log, gnss=replace(log.gnss, status=status)), result).metrics
    assert metrics["methods"]["gnss"]["coverage"] == pytest.approx((19.9 + 0.15 + 29.9) / 59.9)


def test_a_gap_of_the_reference_is_excluded_and_counted() -> None:
    log, result = drive(60.0)
    assert log.reference is not None
    kept = (log.reference.t_ns < START_NS + 20 * S) | (log.reference.t_ns > START_NS + 30 * S)
    metrics = replayed(replace(log, reference=log.reference[kept]), result).metrics
    assert metrics["excluded"] == {"gap": 101}
    assert metrics["duration_s"] == pytest.approx(49.8)
    assert metrics["methods"]["fusion"]["ar"] == 1.0


def test_an_imprecise_reference_is_excluded_by_the_limits_in_force() -> None:
    log, result = drive(60.0, state_error=ERROR)
    log = replace(log, reference=reference(stamps(60.0, 100.0), sigma=(0.12, 0.0)))
    done = replayed(log, result)
    assert done.metrics["excluded"] == {"position_sigma": 600}
    assert done.metrics["methods"]["fusion"]["ar"] is None
    assert metrics_of(done.sums(LIMITS["highway"]))["methods"]["fusion"]["ar"] == 1.0
    sharp = metrics_of(done.sums(Limits(3.0, 3.0, 0.001)))
    assert sharp["excluded"] == {}
    assert sharp["methods"]["fusion"]["ar"] == 0.0


def test_a_reference_without_heading_scores_position_by_its_course() -> None:
    metrics = replayed(*drive(60.0, state_error=ERROR, pose_error=ERROR, attitude=False)).metrics
    assert metrics["reference"]["heading"] == "course"
    for name in ("gnss", "egovm", "fusion"):
        assert metrics["methods"][name]["yaw"] is None
        assert metrics["methods"][name]["ar"] == 1.0
    assert metrics["methods"]["fusion"]["lon"]["p50"] == pytest.approx(0.05, abs=1e-4)
    assert metrics["methods"]["egovm"]["lat"]["p50"] == pytest.approx(0.02, abs=1e-4)


@pytest.mark.parametrize("seconds", [None, 5.0])
def test_too_little_reference_is_not_evaluated(seconds: float | None) -> None:
    log, result = drive(60.0)
    short = None if seconds is None else reference(stamps(seconds, 100.0))
    metrics = replayed(replace(log, reference=short), result).metrics
    assert set(metrics["methods"]) == {"gnss", "egovm", "fusion"}
    for method in metrics["methods"].values():
        assert set(method.values()) == {None}


def test_a_method_without_data_is_absent() -> None:
    log, result = drive(60.0)
    log = replace(log, pose_fixes=None)
    metrics = replayed(log, replace(result, decisions=decisions(log))).metrics
    assert set(metrics["methods"]) == {"gnss", "fusion"}
    assert metrics["decisions"] == {"gnss_position": {"accepted": 600}}


@pytest.mark.parametrize("attitude", [True, False])
def test_lever_arms_and_the_delay_of_gnss_are_taken_into_account(attitude: bool) -> None:
    vehicle = Vehicle(
        gnss_lever_arm=(0.8, -0.3, 1.5),
        reference_lever_arm=(-1.0, 0.2, 0.3),
        pose_lever_arm=(0, 0, 1),
        gnss_delay_s=0.1,
    )
    log, result = drive(60.0, attitude=attitude, vehicle=vehicle)
    assert log.reference is not None
    _, yaw = track(log.reference.t_ns)
    moved = log.reference.p_map + to_map(yaw, np.array(vehicle.reference_lever_arm))
    fixes = gnss(stamps(60.0, 10.0), arm=np.array(vehicle.gnss_lever_arm))
    late = replace(fixes, t_ns=fixes.t_ns + S // 10)
    log = replace(log, reference=replace(log.reference, p_map=moved), gnss=late)
    metrics = replayed(log, replace(result, decisions=decisions(log))).metrics
    for name in ("gnss", "egovm", "fusion"):
        for axis in ("lon", "lat"):
            assert metrics["methods"][name][axis]["p95"] < (1e-4 if attitude else 2e-2), (name, axis)


def hidden_run(log: Log, result: FusionResult, hide: HideGnss) -> Assembled:
    return assemble(log, RunConfig(hide_gnss=hide), result)


def test_hidden_stretches_are_scored_at_the_antenna() -> None:
    vehicle = Vehicle(gnss_lever_arm=(0.8, -0.3, 1.5), gnss_delay_s=0.2)
    log, result = drive(200.0, state_error=(0.3, 0.4, 0.0), with_reference=False, vehicle=vehicle)
    fixes = gnss(stamps(200.0, 10.0), arm=np.array(vehicle.gnss_lever_arm))
    log = replace(log, gnss=replace(fixes, t_ns=fixes.t_ns + S // 5), pose_fixes=None)
    done = hidden_run(log, result, HideGnss(60.0, 15.0))
    hidden = done.metrics["hidden"]
    assert hidden["stretches"] == 3
    assert hidden["length_s"] == 15.0
    for key in ("p50", "p95", "max"):
        assert hidden["end_horizontal_m"][key] == pytest.approx(0.5, abs=1e-3)
    # position 0.1 m each way; yaw and tilt 0.01 rad with the arm: (0.3 0.01)^2 + (0.8 0.01)^2 + 2 (1.5 0.01)^2
    sigma = np.sqrt(2 * 0.1**2 + 1e-4 * (0.3**2 + 0.8**2 + 2 * 1.5**2))
    assert hidden["per_stretch"][0]["end_sigma_m"] == pytest.approx(sigma, rel=1e-6)
    assert hidden["end_error_over_sigma_rms"] == pytest.approx(0.5 / sigma, rel=3e-3)
    assert [entry["start_s"] for entry in hidden["per_stretch"]] == pytest.approx([60.0, 120.0, 180.0])
    assert set(done.metrics["methods"]) == {"fusion"}
    assert done.metrics["duration_s"] == pytest.approx(45.0, abs=0.31)
    assert done.metrics["methods"]["fusion"]["lat"]["p50"] == pytest.approx(0.4, abs=1e-3)
    assert done.metrics["methods"]["fusion"]["yaw"] is None


def test_only_hidden_stretches_are_scored() -> None:
    log, result = drive(200.0, with_reference=False)
    llh = result.states.llh.copy()
    llh[:600] += 1e-3  # kilometres off, but not where it is scored
    result = replace(result, states=replace(result.states, llh=llh))
    metrics = hidden_run(log, result, HideGnss(60.0, 15.0)).metrics
    assert metrics["methods"]["fusion"]["ar"] == 1.0
    assert metrics["excluded"] == {}


def test_a_stretch_that_ends_without_a_fixed_fix_has_no_end_error() -> None:
    log, result = drive(200.0, with_reference=False)
    assert log.gnss is not None
    seconds = (log.gnss.t_ns - START_NS) / S
    status = np.where((seconds > 70) & (seconds < 80), GnssStatus.FLOAT, GnssStatus.FIXED).astype(np.int8)
    metrics = hidden_run(replace(log, gnss=replace(log.gnss, status=status)), result, HideGnss(60.0, 15.0)).metrics
    hidden = metrics["hidden"]
    assert (hidden["stretches"], hidden["without_end"]) == (2, 1)
    assert hidden["per_stretch"][0]["end_horizontal_m"] is None
    assert metrics["excluded"] == {"gap": 49}


def test_decisions_keep_the_row_numbers_of_the_log() -> None:
    log, result = drive(200.0, with_reference=False)
    done = hidden_run(log, result, HideGnss(60.0, 15.0))
    assert log.gnss is not None
    rows = done.decisions["row"][done.decisions["sensor"] == 0]
    np.testing.assert_array_equal(log.gnss.t_ns[rows], done.decisions["t_ns"][done.decisions["sensor"] == 0])


def test_the_worked_example_of_the_documentation() -> None:
    seconds = stamps(1.1, 10.0)[[0, 1, 2, 3, 8, 9, 10]]
    log, result = drive(1.1)
    fixes = gnss(seconds)
    _, yaw = track(seconds[5:6])
    left = gnss(seconds[5:6], tuple(to_map(yaw, np.array((0.0, 0.4, 0.0)))[0]))
    llh = fixes.llh.copy()
    llh[5] = left.llh[0]
    log = replace(log, gnss=replace(fixes, llh=llh), reference=reference(stamps(1.01, 100.0)))
    found = replayed(log, replace(result, decisions=decisions(log))).sums(LIMITS["paper"]).segments
    row = {
        name: int(found.columns[name][found.of_method("gnss")].sum())
        for name in ("evaluated_ns", "covered_ns", "good_ns")
    }
    assert row == {"evaluated_ns": S, "covered_ns": 65 * S // 100, "good_ns": 55 * S // 100}
    lateral = found.chosen(found.of_method("gnss")).columns
    assert lateral["lat_abs"].sum() / lateral["lat_count"].sum() == pytest.approx(0.4 / 6, abs=1e-6)
