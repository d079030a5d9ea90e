"""Sums of made-up tables: the same however they are cut, and the same as plain arithmetic over the whole."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion.result import Sensor
from replay.config import LIMITS
from replay.metrics import metrics_of
from replay.segments import NUMBERS
from replay.sums import Sums, merge
from sensors.clock import NS_PER_S
from tests.replay.made_up_tables import PERIOD_NS, SCENES, START_NS, batches, facts, scored, tables

SECONDS = 400.0
PAPER = LIMITS["paper"]
Columns = dict[str, NDArray[Any]]
TABLES = tables(1, SECONDS)
HIDDEN = tables(2, SECONDS, hidden=True)


def whole(*, hidden: bool = False, cuts: NDArray[np.int64] | None = None) -> Sums:
    told = facts(hidden_s=5.0, seconds=SECONDS) if hidden else facts()
    none = np.empty(0, np.int64)
    return scored(batches(*(HIDDEN if hidden else TABLES), none if cuts is None else cuts), PAPER, told)


def check_same(a: Sums, b: Sums) -> None:
    for name in NUMBERS:
        np.testing.assert_array_equal(a.segments.columns[name], b.segments.columns[name], err_msg=name)
    assert a.segments.to_arrow().equals(b.segments.to_arrow())
    assert a.sketch.keys == b.sketch.keys
    for name in ("edges", "bin", "count"):
        np.testing.assert_array_equal(getattr(a.sketch, name), getattr(b.sketch, name))
    assert a.counts == b.counts


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, round(SECONDS * 1000)), max_size=40), st.booleans())
def test_sums_are_the_same_however_the_drive_is_cut(milliseconds: list[int], hidden: bool) -> None:
    cuts = START_NS + np.array(milliseconds, np.int64) * 1_000_000
    check_same(whole(hidden=hidden, cuts=cuts), whole(hidden=hidden))


def test_the_tables_may_come_one_ahead_of_the_other() -> None:
    states, decisions = TABLES
    empty = tuple({name: column[:0] for name, column in table.items()} for table in TABLES)
    cuts = START_NS + np.arange(1, 8) * 50 * NS_PER_S
    parts = list(batches(states, decisions, cuts))
    early = [*((part[0], empty[1]) for part in parts), *((empty[0], part[1]) for part in parts)]
    late = [*((empty[0], part[1]) for part in parts), *((part[0], empty[1]) for part in parts)]
    for order in (early, late):
        check_same(scored(iter(order), PAPER, facts()), whole())


def rows_of(table: Columns, sensor: Sensor) -> Columns:
    """Each fix once, if it has a position."""
    rows = np.flatnonzero((table["sensor"] == sensor) & (table["status"] != 0))
    rows = rows[np.unique(table["row"][rows], return_index=True)[1]]
    return {name: column[rows] for name, column in table.items()}


def evaluated_epochs() -> NDArray[np.bool_]:
    states = TABLES[0]
    bad_yaw = np.isfinite(states["ref_yaw"]) & (np.degrees(states["ref_sigma_yaw"]) > 1 / 3)
    evaluated: NDArray[np.bool_] = (states["excluded"] == 0) & ~(states["ref_sigma_m"] > 0.1) & ~bad_yaw
    evaluated[0] = False
    return evaluated


def plainly(t_ns: NDArray[np.int64], error: NDArray[np.float64], period_ns: float, *, sensor: bool) -> dict[str, float]:
    """Shares and errors of outputs, interval by interval; error (N, 3) m, m, rad."""
    states, evaluated = TABLES[0], evaluated_epochs()
    ends = states["t_ns"][1:]
    begins = np.maximum(states["t_ns"][:-1], ends - round(1.5 * PERIOD_NS))
    inside = evaluated[1:]
    total = int((ends - begins)[inside].sum())
    covered, good, unknown, counted = 0, 0, 0, []
    for i in range(len(t_ns)):
        begin = max(int(t_ns[i - 1]), int(t_ns[i]) - round(1.5 * period_ns)) if i else int(t_ns[i])
        shared = np.minimum(ends, t_ns[i]) - np.maximum(begins, begin)
        time = int(shared[inside & (shared > 0)].sum())
        if np.isnan(error[i, 0]):
            unknown += time if sensor else 0
            continue
        limits = (0.6, 0.3) if np.isnan(error[:, 2]).all() else (0.6, 0.3, np.radians(1.0))
        covered += time
        good += time * bool(all(abs(e) < limit for e, limit in zip(error[i], limits, strict=False)))
        if time:
            counted.append(i)
    size = np.abs(error[counted])
    return {
        "ar": good / (total - unknown),
        "coverage": covered / (total - unknown),
        "lon_mae": float(size[:, 0].mean()),
        "lat_rmse": float(np.sqrt((size[:, 1] ** 2).mean())),
        "lat_p95": float(np.percentile(size[:, 1], 95)),
        "lon_max": float(size[:, 0].max()),
        "lat_below": float((size[:, 1] < 0.2).mean()),
    }


@pytest.mark.parametrize("method", ["gnss", "egovm", "fusion"])
def test_figures_are_those_of_plain_arithmetic(method: str) -> None:
    table = TABLES[0]
    period = float(PERIOD_NS)
    if method != "fusion":
        table = rows_of(TABLES[1], Sensor.GNSS_POSITION if method == "gnss" else Sensor.POSE_FIX)
        early = table["t_ns"][table["t_ns"] <= table["t_ns"][0] + 300 * NS_PER_S]
        period = float(np.median(np.diff(early)))
    error = np.stack([table[name] for name in ("err_lon", "err_lat", "err_yaw")], axis=-1)
    expected = plainly(table["t_ns"], error, period, sensor=method != "fusion")
    found = metrics_of(whole())["methods"][method]
    assert found["ar"] == pytest.approx(expected["ar"], rel=1e-12)
    assert found["coverage"] == pytest.approx(expected["coverage"], rel=1e-12)
    assert found["lon"]["mae"] == pytest.approx(expected["lon_mae"], rel=1e-12)
    assert found["lat"]["rmse"] == pytest.approx(expected["lat_rmse"], rel=1e-12)
    assert found["lat"]["p95"] == pytest.approx(expected["lat_p95"], rel=2e-3)
    assert found["lon"]["max"] == expected["lon_max"]
    assert found["lat"]["below"]["0.2"] == expected["lat_below"]


def test_exposure_is_that_of_the_evaluated_grid() -> None:
    states, evaluated = TABLES[0], evaluated_epochs()
    cover = np.minimum(np.diff(states["t_ns"], prepend=START_NS), round(1.5 * PERIOD_NS))
    speed = np.nan_to_num(states["ref_speed"])
    metrics = metrics_of(whole())
    assert metrics["epochs"] == evaluated.sum()
    assert metrics["duration_s"] == pytest.approx(cover[evaluated].sum() / NS_PER_S, rel=1e-12)
    assert metrics["distance_m"] == pytest.approx((cover * speed)[evaluated].sum() / NS_PER_S, rel=1e-12)


def test_slices_share_out_the_whole() -> None:
    metrics = metrics_of(whole())
    scenes, modes = metrics["slices"]["scene"], metrics["slices"]["mode"]
    assert list(scenes) == ["canyon", "city", "night", "tunnel"]
    assert scenes["canyon"] == scenes["night"]  # always together
    assert list(modes) == ["autonomous", "open-loop"]
    assert sum(part["epochs"] for part in modes.values()) == metrics["epochs"]
    assert sum(part["hours"] for part in modes.values()) == pytest.approx(metrics["duration_s"] / 3600, rel=1e-12)
    assert sum(part["km"] for part in modes.values()) == pytest.approx(metrics["distance_m"] / 1000, rel=1e-12)
    for method in ("gnss", "egovm", "fusion"):
        shares = [(part["methods"][method]["ar"], part["hours"]) for part in modes.values()]
        mean = sum(ar * hours for ar, hours in shares) / sum(hours for _, hours in shares)
        assert mean == pytest.approx(
            metrics["methods"][method]["ar"], abs=2e-3
        )  # a fix without reference belongs to none
        largest = [part["methods"][method]["lon"]["max"] for part in modes.values()]
        assert max(largest) == metrics["methods"][method]["lon"]["max"]


def test_a_slice_holds_the_epochs_under_its_tag() -> None:
    states, evaluated = TABLES[0], evaluated_epochs()
    tunnel = evaluated & (states["scene"] == SCENES.index("tunnel"))
    known = tunnel & np.isfinite(states["err_lon"])
    found = metrics_of(whole())["slices"]["scene"]["tunnel"]
    assert found["epochs"] == tunnel.sum()
    assert found["methods"]["fusion"]["lon"]["mae"] == pytest.approx(np.abs(states["err_lon"][known]).mean(), rel=1e-12)


def test_without_tags_there_are_no_slices() -> None:
    plain = tuple({**table, "scene": 0 * table["scene"], "mode": 0 * table["mode"]} for table in TABLES)
    metrics = metrics_of(scored(batches(*plain, np.empty(0, np.int64)), PAPER, facts()))
    assert metrics["slices"] == {}
    for name, method in metrics_of(whole())["methods"].items():
        for axis in ("lon", "lat", "yaw"):
            flat = {key: value for key, value in (method[axis] or {}).items() if key != "below"}
            assert {key: (metrics["methods"][name][axis] or {}).get(key) for key in flat} == pytest.approx(
                flat, rel=1e-12
            )
        assert metrics["methods"][name]["ar"] == method["ar"]


def test_a_slice_of_seconds_is_not_evaluated() -> None:
    scene = np.where(TABLES[0]["t_ns"] < START_NS + 9 * NS_PER_S, 3, 1).astype(np.int16)
    states = {**TABLES[0], "scene": scene}
    decisions = {**TABLES[1], "scene": np.ones(len(TABLES[1]["t_ns"]), np.int16)}
    slices = metrics_of(scored(batches(states, decisions, np.empty(0, np.int64)), PAPER, facts()))["slices"]["scene"]
    assert slices["tunnel"]["epochs"] > 0
    assert set(slices["tunnel"]["methods"]["fusion"].values()) == {None}
    assert slices["city"]["methods"]["fusion"]["ar"] > 0


def test_a_method_that_a_slice_has_for_seconds_only_is_not_evaluated_there() -> None:
    """Of two logs of tunnel, the one with pose fixes is there for nine seconds."""
    scene = np.where(TABLES[0]["t_ns"] < START_NS + 9 * NS_PER_S, 3, 1).astype(np.int16)
    short = scored(batches({**TABLES[0], "scene": scene}, TABLES[1], np.empty(0, np.int64)), PAPER, facts())
    long = {**TABLES[0], "scene": np.full_like(scene, 3)}
    others = {name: column[TABLES[1]["sensor"] != Sensor.POSE_FIX] for name, column in TABLES[1].items()}
    both = merge([("short", short), ("long", scored(batches(long, others, np.empty(0, np.int64)), PAPER, facts()))])
    tunnel = metrics_of(both)["slices"]["scene"]["tunnel"]["methods"]
    assert tunnel["fusion"]["ar"] > 0
    assert set(tunnel["egovm"].values()) == {None}


def test_hidden_stretches_end_at_their_last_known_epoch() -> None:
    states, decisions = HIDDEN
    metrics = metrics_of(whole(hidden=True))
    assert set(metrics["methods"]) == {"egovm", "fusion"}
    entry = metrics["hidden"]["per_stretch"][3]
    known = np.all([np.isfinite(states[name]) for name in ("sigma_lon", "sigma_lat")], axis=0)
    last = np.flatnonzero(known & (states["stretch"] == 3))[-1]
    miss = np.hypot(states["x"][last] - states["ref_x"][last], states["y"][last] - states["ref_y"][last])
    assert entry["start_s"] == 60.0
    assert entry["end_horizontal_m"] == miss
    used = decisions["accepted"] & (decisions["sensor"] == 0) & (decisions["t_ns"] <= states["t_ns"][last])
    assert entry["since_gnss_s"] == (states["t_ns"][last] - decisions["t_ns"][used].max()) / NS_PER_S
