"""Sums of logs: through files unchanged, and merged in any order to the same digits."""

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from replay.config import LIMITS
from replay.metrics import metrics_of
from replay.sums import EXAMPLES, MIXED, Sums, merge, read_segments
from sensors.errors import EgolocError
from tests.replay.made_up_tables import batches, facts, scored, tables

NO_CUTS = np.empty(0, np.int64)
EXTENSIVE = ("duration_s", "distance_m", "epochs", "span_s")


def log(seed: int, name: str = "drive", seconds: float = 100.0) -> Sums:
    return scored(batches(*tables(seed, seconds), NO_CUTS), LIMITS["paper"], facts(), name)


LOGS = {f"drive-{seed}": log(seed, f"drive-{seed}") for seed in range(5)}


def stored(sums: Sums, folder: Path) -> dict[str, bytes]:
    folder.mkdir(exist_ok=True)
    sums.to_parquet(folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def changed(sums: Sums, **counts: object) -> Sums:
    return replace(sums, counts=msgspec.structs.replace(sums.counts, **counts))


def test_files_hold_everything(tmp_path: Path) -> None:
    for sums in (log(1), merge(LOGS.items()), log(1, seconds=0.0)):
        first = stored(sums, tmp_path / "first")
        again = Sums.from_parquet(tmp_path / "first")
        assert json.dumps(metrics_of(again)) == json.dumps(metrics_of(sums))
        assert stored(again, tmp_path / "again") == first


def test_a_campaign_of_one_log_has_its_figures() -> None:
    one = metrics_of(LOGS["drive-1"])
    campaign = metrics_of(merge([("drive-1", LOGS["drive-1"])]), logs={"total": 1, "done": 1, "failed": []})
    named = [{**entry, "log": "drive-1"} for entry in one.pop("warnings")]
    assert campaign.pop("warnings") == named
    assert campaign.pop("logs") == {"total": 1, "done": 1, "failed": []}
    assert campaign.pop("warning_counts") == {"lost": 1}
    assert one.pop("estimates") == []  # of a drive, not of many
    assert campaign == one


def test_the_order_of_logs_does_not_matter(tmp_path: Path) -> None:
    names = list(LOGS)
    first = stored(merge((name, LOGS[name]) for name in names), tmp_path / "first")
    for order in (names[::-1], [names[i] for i in (3, 0, 4, 1, 2)]):
        assert stored(merge((name, LOGS[name]) for name in order), tmp_path / "other") == first


def test_a_campaign_is_the_sum_of_its_logs() -> None:
    whole, parts = metrics_of(merge(LOGS.items())), [metrics_of(sums) for sums in LOGS.values()]
    for key in EXTENSIVE:
        assert whole[key] == pytest.approx(sum(part[key] for part in parts), rel=1e-12)
    assert whole["excluded"] == {key: sum(part["excluded"][key] for part in parts) for key in whole["excluded"]}
    fusion = [part["methods"]["fusion"] for part in parts]
    hours = [part["duration_s"] for part in parts]
    ar = sum(f["ar"] * h for f, h in zip(fusion, hours, strict=True)) / sum(hours)
    assert whole["methods"]["fusion"]["ar"] == pytest.approx(ar, rel=1e-12)
    assert whole["methods"]["fusion"]["lon"]["max"] == max(f["lon"]["max"] for f in fusion)
    assert whole["left_out"] == [{"source": "/imu", "reason": "stamp repeats", "count": 15}]
    assert whole["decisions"]["wheel"]["accepted"] == sum(part["decisions"]["wheel"]["accepted"] for part in parts)


def test_percentiles_of_a_campaign_are_those_of_all_its_epochs() -> None:
    errors = np.concatenate([_evaluated_errors(seed) for seed in range(5)])
    found = metrics_of(merge(LOGS.items()))["methods"]["fusion"]["lon"]
    for name, share in (("p50", 50), ("p95", 95), ("p99", 99)):
        assert found[name] == pytest.approx(np.percentile(errors, share), rel=2e-3)


def _evaluated_errors(seed: int) -> np.ndarray:
    states = tables(seed, 100.0)[0]
    bad_yaw = np.isfinite(states["ref_yaw"]) & (np.degrees(states["ref_sigma_yaw"]) > 1 / 3)
    chosen = (states["excluded"] == 0) & ~(states["ref_sigma_m"] > 0.1) & ~bad_yaw & np.isfinite(states["err_lon"])
    chosen[0] = False
    return np.abs(states["err_lon"][chosen])


def test_segments_of_a_campaign_name_their_logs(tmp_path: Path) -> None:
    stored(merge(LOGS.items()), tmp_path / "run")
    _, segments = read_segments(tmp_path / "run")
    of_log = segments.columns["log"] == segments.texts["log"].index("drive-3")
    own = LOGS["drive-3"].segments
    np.testing.assert_array_equal(segments.columns["lon_abs"][of_log], own.columns["lon_abs"])


class TestMergedCounts:
    def test_warnings_are_counted_and_some_are_named(self) -> None:
        one = LOGS["drive-0"]
        whole = merge((f"log-{i:03d}", one) for i in range(EXAMPLES + 5)).counts
        assert whole.warning_counts == {"lost": EXAMPLES + 5}
        assert [entry["log"] for entry in whole.warnings] == [f"log-{i:03d}" for i in range(EXAMPLES)]

    def test_what_logs_say_differently_is_mixed(self) -> None:
        course = changed(LOGS["drive-1"], reference={"kind": "odometry", "source": None, "heading": "course"})
        reference = merge([("a", LOGS["drive-0"]), ("b", course)]).counts.reference
        assert reference == {"kind": "odometry", "source": "log", "heading": MIXED}

    def test_a_source_with_the_logs_own_name_is_its_file(self) -> None:
        entries = [{"source": f"{name}.mcap", "reason": "the file is truncated", "count": 1} for name in ("a", "b")]
        parts = [(n, changed(LOGS["drive-0"], left_out=[e])) for n, e in zip(("a", "b"), entries, strict=True)]
        assert merge(parts).counts.left_out == [{"source": "log file", "reason": "the file is truncated", "count": 2}]

    def test_hidden_stretches_are_joined(self) -> None:
        told = facts(hidden_s=5.0, seconds=100.0)
        hidden = scored(batches(*tables(1, 100.0, hidden=True), NO_CUTS), LIMITS["paper"], told)
        one, both = metrics_of(hidden), metrics_of(merge([("a", hidden), ("b", hidden)]))
        assert both["hidden"]["stretches"] == 2 * one["hidden"]["stretches"]
        assert [entry["log"] for entry in both["hidden"]["per_stretch"]] == ["a"] * 5 + ["b"] * 5
        assert both["hidden"]["end_horizontal_m"]["max"] == one["hidden"]["end_horizontal_m"]["max"]

    def test_alignment_is_that_of_the_slowest(self) -> None:
        parts = [(name, changed(LOGS["drive-0"], alignment_s=s)) for name, s in (("a", 3.0), ("b", None), ("c", 9.0))]
        assert merge(parts).counts.alignment_s == 9.0

    def test_logs_of_different_limits_are_refused(self) -> None:
        other = changed(LOGS["drive-1"], limits=LIMITS["highway"])
        with pytest.raises(EgolocError, match="b: expected the limits and order of a, got others"):
            merge([("a", LOGS["drive-0"]), ("b", other)])


class TestDamage:
    def test_a_missing_file(self, tmp_path: Path) -> None:
        with pytest.raises(EgolocError, match=r"segments\.parquet: missing: expected a run folder"):
            Sums.from_parquet(tmp_path)

    def test_a_file_without_counts(self, tmp_path: Path) -> None:
        import pyarrow.parquet as pq

        stored(LOGS["drive-0"], tmp_path)
        table = pq.read_table(tmp_path / "segments.parquet").replace_schema_metadata(None)
        pq.write_table(table, tmp_path / "segments.parquet")
        with pytest.raises(EgolocError, match=r"segments\.parquet: metadata egoloc: Object missing required field"):
            Sums.from_parquet(tmp_path)

    def test_a_column_that_is_missing_or_of_another_kind(self, tmp_path: Path) -> None:
        import pyarrow.parquet as pq

        stored(LOGS["drive-0"], tmp_path)
        table = pq.read_table(tmp_path / "segments.parquet")
        pq.write_table(table.drop_columns(["good_ns"]), tmp_path / "segments.parquet")
        with pytest.raises(EgolocError, match=r"expected the columns of a run, without: good_ns"):
            Sums.from_parquet(tmp_path)
        numbers = table.set_column(table.column_names.index("good_ns"), "good_ns", table["good_m"])
        pq.write_table(numbers, tmp_path / "segments.parquet")
        with pytest.raises(EgolocError, match=r"column good_ns: expected int64 without nulls, got double"):
            Sums.from_parquet(tmp_path)


def test_an_hour_of_sums_is_small(tmp_path: Path) -> None:
    files = stored(log(7, seconds=3600.0), tmp_path)
    assert sum(map(len, files.values())) < 300_000
