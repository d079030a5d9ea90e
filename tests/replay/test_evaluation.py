"""Rows of both tables: the same to the last bit however the drive is cut."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.result import Sensor
from replay.config import HideGnss, RunConfig
from replay.drive import Drive
from replay.references import Excluded
from sensors.records import GnssStatus, Log, Tags, Trajectory
from sensors.simulate.drive import simulate
from sensors.simulate.scenarios import load
from tests.fusion.arrivals import scattered
from tests.replay.cutting import cut_at, equal, random_edges, rows_of

S = 1_000_000_000
DURATION_S = 1000.0


@pytest.fixture(scope="module")
def drive() -> Log:
    scenario = load("demo")
    rates = {"imu": 50.0, "wheel": 10.0, "reference": 20.0}
    slower = {name: msgspec.structs.replace(getattr(scenario, name), rate_hz=hz) for name, hz in rates.items()}
    log = simulate(DURATION_S, 5, msgspec.structs.replace(scenario, **slower))
    return replace(log, scene=None, mode=None)


def reference_of(log: Log) -> Trajectory:
    assert log.reference is not None
    return log.reference


def seconds(log: Log, t_ns: Any) -> Any:
    assert log.imu is not None
    return (t_ns - log.imu.t_ns[0]) / S


def with_gaps(log: Log) -> Log:
    track = reference_of(log)
    s = seconds(log, track.t_ns)
    return replace(log, reference=track[~((s > 50) & (s < 50.4) | (s > 100) & (s < 102) | (s > 400) & (s < 450))])


def without_attitude(log: Log) -> Log:
    track = reference_of(log)
    return replace(log, reference=Trajectory(track.t_ns, track.arrival_ns, track.p_map, None, track.sigma))  # type: ignore[arg-type]


def with_missing_attitude(log: Log) -> Log:
    track = reference_of(log)
    missing = (np.arange(len(track)) // 500) % 3 == 0
    return replace(log, reference=replace(track, q_map_body=np.where(missing[:, None], np.nan, track.q_map_body)))


def at_4_hz(log: Log) -> Log:
    return without_attitude(replace(log, reference=reference_of(log)[::5]))


def between(first_s: float, last_s: float) -> Any:
    def part(log: Log) -> Log:
        s = seconds(log, reference_of(log).t_ns)
        return replace(log, reference=reference_of(log)[(s > first_s) & (s < last_s)])

    return part


def pausing(first_s: float, last_s: float) -> Any:
    def part(log: Log) -> Log:
        s = seconds(log, reference_of(log).t_ns)
        return replace(log, reference=reference_of(log)[(s < first_s) | (s > last_s)])

    return part


def with_tags(log: Log) -> Log:
    assert log.imu is not None
    rng = np.random.default_rng(1)
    at = [log.imu.t_ns[0] + np.sort(rng.integers(-20 * S, int(DURATION_S) * S, n)) for n in (25, 4)]
    texts = ("city", "tunnel", "canyon,night", ""), ("open-loop", "autonomous")
    scene, mode = (
        Tags(t, t, np.array(text)[rng.integers(0, len(text), len(t))]) for t, text in zip(at, texts, strict=True)
    )
    return replace(log, scene=scene, mode=mode)


def never_aligned(log: Log) -> Log:
    assert log.gnss is not None
    return replace(log, gnss=log.gnss[:3], gnss_velocity=None, pose_fixes=None, wheel=None)


def gnss_until(last_s: float, again_s: float = DURATION_S) -> Any:
    def part(log: Log) -> Log:
        assert log.gnss is not None
        s = seconds(log, log.gnss.t_ns)
        return replace(log, gnss=log.gnss[(s < last_s) | (s > again_s)])

    return part


def with_delays(log: Log) -> Log:
    return replace(log, vehicle=msgspec.structs.replace(log.vehicle, gnss_delay_s=0.3, gnss_velocity_delay_s=0.1))


def out_of_order(log: Log) -> Log:
    """Fixes and pose fixes up to 1.3 s late, whose history is a second."""
    return scattered(log, 9, 1.3, ("gnss", "gnss_velocity", "pose_fixes"))


HIDE = {"hide_gnss": HideGnss(60.0, 15.0)}
ARRIVAL = {"fusion": FusionConfig(order="arrival")}
CASES = {
    "plain": (lambda log: log, {}),
    "tags": (with_tags, {}),
    "gaps": (with_gaps, {}),
    "no attitude, gaps": (lambda log: without_attitude(with_gaps(log)), {}),
    "4 Hz": (at_4_hz, {}),
    "attitude comes and goes": (with_missing_attitude, {}),
    "reference begins late": (lambda log: without_attitude(between(400.0, DURATION_S)(log)), {}),
    "longer than its reference": (between(200.0, 500.0), {}),
    "reference pauses for long": (pausing(150.0, 800.0), {}),
    "one row of reference": (lambda log: replace(log, reference=reference_of(log)[5000:5001]), {}),
    "no reference": (lambda log: replace(log, reference=None), {}),
    "never aligned": (never_aligned, {}),
    "delays": (with_delays, {}),
    "hidden": (lambda log: log, HIDE),
    "hidden often": (with_delays, {"hide_gnss": HideGnss(7.0, 3.3)}),
    "hidden, GNSS ends": (gnss_until(400.0), HIDE),
    "hidden, GNSS pauses": (gnss_until(130.0, 800.0), HIDE),
    "arrival": (with_tags, ARRIVAL),
    "arrival, out of order": (out_of_order, ARRIVAL),
    "arrival, delays": (with_delays, ARRIVAL),
    "arrival, never aligned": (never_aligned, ARRIVAL),
    "arrival, hidden": (out_of_order, HIDE | ARRIVAL),
}


@pytest.mark.parametrize("case", CASES)
def test_the_same_bits_however_the_drive_is_cut(case: str, drive: Log) -> None:
    change, given = CASES[case]
    log, config = change(drive), RunConfig(**given)
    states, decisions, whole = rows_of([log], config)
    assert len(states["t_ns"]) > 9000
    assert (np.diff(states["t_ns"]) > 0).all()
    rng = np.random.default_rng(len(case))
    for count in (1, 7, 40):
        cut_states, cut_decisions, done = rows_of(cut_at(log, random_edges(log, count, rng)), config)
        assert equal(cut_states, states) == []
        assert equal(cut_decisions, decisions) == []
        assert done.facts() == whole.facts()


def test_a_reference_file_is_used_whole_however_the_drive_is_cut(drive: Log, tmp_path: Any) -> None:
    track = reference_of(drive)[::2]
    path = tmp_path / "truth.tum"
    rows = np.column_stack((track.p_map, track.q_map_body))
    lines = [
        f"{t // S}.{t % S:09d} " + " ".join(map(repr, row))
        for t, row in zip(track.t_ns.tolist(), rows.tolist(), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    states, decisions, whole = rows_of([drive], RunConfig(), reference_file=path)
    assert whole.facts()["reference"] == {"kind": "odometry", "source": "truth.tum", "heading": "attitude"}
    assert (states["excluded"] == Excluded.EVALUATED).mean() > 0.99
    edges = random_edges(drive, 12, np.random.default_rng(0))
    cut_states, cut_decisions, _ = rows_of(cut_at(drive, edges), RunConfig(), reference_file=path)
    assert equal(cut_states, states) == []
    assert equal(cut_decisions, decisions) == []


def test_a_row_has_the_tag_that_holds_at_its_time(drive: Log) -> None:
    log = with_tags(drive)
    states, decisions, _ = rows_of(cut_at(log, random_edges(log, 9, np.random.default_rng(4))), RunConfig())
    for tags, name in ((log.scene, "scene"), (log.mode, "mode")):
        assert tags is not None
        for rows in (states, decisions):
            before = np.searchsorted(tags.t_ns, rows["t_ns"], side="right") - 1
            np.testing.assert_array_equal(rows[name], np.where(before < 0, "", tags.text[before]))
    assert {"city", "tunnel", "canyon,night", ""} == set(states["scene"])


def test_rows_of_a_drive_with_hidden_gnss_name_the_rows_of_the_log(drive: Log) -> None:
    states, decisions, whole = rows_of(
        cut_at(drive, random_edges(drive, 9, np.random.default_rng(5))), RunConfig(**HIDE)
    )
    stretches = np.array(whole.facts()["stretches"])
    assert len(stretches) == int((DURATION_S - 15.0) // 60.0)
    assert set(states["stretch"]) == {-1, *range(len(stretches))}
    assert drive.gnss is not None
    assert drive.gnss_velocity is not None
    for sensor, record in ((Sensor.GNSS_POSITION, drive.gnss), (Sensor.GNSS_VELOCITY, drive.gnss_velocity)):
        here = decisions["sensor"] == sensor
        np.testing.assert_array_equal(record.t_ns[decisions["row"][here]], decisions["t_ns"][here])
        assert 0 < here.sum() < len(record)
    fixed = drive.gnss.t_ns[drive.gnss.status == GnssStatus.FIXED]
    scored = states["t_ns"][states["excluded"] == Excluded.EVALUATED]
    assert np.isin(scored, fixed).mean() > 0.9


@pytest.mark.parametrize(("again_s", "why"), [(700.0, Excluded.GAP), (800.0, Excluded.OUTSIDE)])
def test_in_a_long_pause_the_reference_is_over(again_s: float, why: Excluded, drive: Log) -> None:
    states, _, _ = rows_of(cut_at(pausing(150.0, again_s)(drive), []), RunConfig())
    s = seconds(drive, states["t_ns"])
    assert (states["excluded"][(s > 150.2) & (s < again_s - 0.2)] == why).all()
    assert (states["excluded"][(s > again_s + 1.0) & (s < DURATION_S - 1.0)] == Excluded.EVALUATED).all()


def test_nothing_waits_for_a_reference_that_is_over(drive: Log) -> None:
    """Rows wait 720 s at most: what is held does not grow with the drive."""
    log = between(0.0, 100.0)(drive)
    assert log.imu is not None
    edges = [int(log.imu.t_ns[0]) + s * S for s in range(100, 1000, 100)]
    taken = Drive(log, RunConfig(), "drive")
    counts = [len(taken.push(piece).states["t_ns"]) for piece in cut_at(log, edges)]
    assert counts[:8] == [0, 0, 0, pytest.approx(995, abs=5), 0, 0, 0, 0]  # it is judged after 360 s
    assert sum(counts) == pytest.approx(10 * (DURATION_S - 120.0), abs=5)
