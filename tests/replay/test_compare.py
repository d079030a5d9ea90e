"""Two runs side by side: pairs, differences and their intervals."""

import io
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from fusion.result import Sensor
from replay.cli import main
from replay.compare import FIGURES, SUMMED, Pairs, compare, figures, intervals, paired
from replay.comparison import print_comparison
from replay.config import LIMITS, Limits
from replay.metrics import metrics_of
from replay.segments import METHODS, Segments
from replay.sums import Sums, merge
from sensors.errors import EgolocError
from tests.replay.made_up_tables import batches, facts, scored, tables

NO_CUTS = np.empty(0, np.int64)
SECONDS = 720.0
FUSION = METHODS.index("fusion")


def log(seed: int, scale: float = 1.0, limits: Limits = LIMITS["paper"], seconds: float = SECONDS) -> Sums:
    """A drive; scale: of the fused errors."""
    states, decisions = tables(seed, seconds)
    states = states | {name: scale * states[name] for name in ("err_lon", "err_lat", "err_yaw")}
    return scored(batches(states, decisions, NO_CUTS), limits, facts(), f"drive-{seed}")


def run(folder: Path, sums: Sums, identity: str = "1") -> Path:
    """A run folder of one log, as far as it is compared."""
    folder.mkdir()
    sums.to_parquet(folder)
    (folder / "manifest.json").write_text(json.dumps({"log": {"path": folder.name, "sha256": identity}}))
    return folder


def campaign(folder: Path, logs: dict[str, Sums]) -> Path:
    folder.mkdir()
    merge(logs.items()).to_parquet(folder)
    (folder / "manifest.json").write_text(json.dumps({"kind": "campaign", "logs": []}))
    return folder


def find(found: dict[str, Any], kind: str, tag: str, method: str, figure: str) -> dict[str, Any]:
    return next(
        r for r in found["rows"] if (r["slice"], r["tag"], r["method"], r["figure"]) == (kind, tag, method, figure)
    )


class TestRuns:
    def test_figures_are_those_of_metrics(self, tmp_path: Path) -> None:
        a, b = log(1), log(1, 0.5)
        found = compare(run(tmp_path / "a", a), run(tmp_path / "b", b), resamples=50)
        assert (found["only_a"], found["only_b"], found["pairs"]) == (0, 0, 12)
        for key, metrics in (("a", metrics_of(a)), ("b", metrics_of(b))):
            for method in ("gnss", "egovm", "fusion"):
                own = metrics["methods"][method]
                assert find(found, "all", "", method, "ar")[key] == pytest.approx(own["ar"], rel=1e-12)
                assert find(found, "all", "", method, "lon_mae")[key] == pytest.approx(own["lon"]["mae"], rel=1e-12)
                assert find(found, "all", "", method, "lat_rmse")[key] == pytest.approx(own["lat"]["rmse"], rel=1e-12)
            canyon = metrics["slices"]["scene"]["canyon"]["methods"]["fusion"]
            row = find(found, "scene", "canyon", "fusion", "yaw_mae")
            assert row[key] == pytest.approx(canyon["yaw"]["mae"], rel=1e-12)
            assert find(found, "mode", "autonomous", "fusion", "coverage")[key] == pytest.approx(
                metrics["slices"]["mode"]["autonomous"]["methods"]["fusion"]["coverage"], rel=1e-12
            )

    def test_half_the_error_is_found(self, tmp_path: Path) -> None:
        found = compare(run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1, 0.5)))
        row = find(found, "all", "", "fusion", "lon_mae")
        assert row["difference"] == pytest.approx(-row["a"] / 2, rel=1e-9)
        assert row["low"] <= row["difference"] <= row["high"] < 0
        assert row["significant"]
        assert all(r["difference"] == 0 for r in found["rows"] if r["method"] != "fusion")

    def test_identical_runs_differ_by_exactly_nothing(self, tmp_path: Path) -> None:
        found = compare(run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1)), resamples=200)
        assert {(row["difference"], row["low"], row["high"], row["significant"]) for row in found["rows"]} == {
            (0.0, 0.0, 0.0, False)
        }

    def test_the_seed_decides(self, tmp_path: Path) -> None:
        a, b = run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1, 0.9))
        first = compare(a, b, 100, seed=1)
        assert json.dumps(compare(a, b, 100, seed=1)) == json.dumps(first)
        assert compare(a, b, 100, seed=2)["rows"] != first["rows"]

    def test_segments_without_partner_are_counted(self, tmp_path: Path) -> None:
        found = compare(run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1, seconds=200.0)), resamples=10)
        assert (found["pairs"], found["only_a"], found["only_b"]) == (4, 8, 0)

    def test_the_same_log_under_another_name(self, tmp_path: Path) -> None:
        other = merge([("renamed", log(1))])
        assert compare(run(tmp_path / "a", log(1)), run(tmp_path / "b", other), resamples=10)["pairs"] == 12

    def test_campaigns_pair_by_log_and_segment(self, tmp_path: Path) -> None:
        logs = {f"drive-{seed}": log(seed) for seed in range(3)}
        a = campaign(tmp_path / "a", logs)
        b = campaign(tmp_path / "b", {"drive-2": log(2), "drive-9": log(1), "drive-1": log(1, 0.5)})
        found = compare(a, b, resamples=10)
        assert (found["pairs"], found["only_a"], found["only_b"]) == (24, 12, 12)
        both = metrics_of(merge([("drive-1", log(1, 0.5)), ("drive-2", log(2))]))["methods"]["fusion"]
        assert find(found, "all", "", "fusion", "lat_mae")["b"] == pytest.approx(both["lat"]["mae"], rel=1e-12)

    def test_a_method_counts_where_both_evaluated_it(self, tmp_path: Path) -> None:
        """Of B's two logs one has no pose fixes: A's EgoVM is compared over the other alone."""
        states, decisions = tables(2, SECONDS)
        others = decisions["sensor"] != Sensor.POSE_FIX
        without = {name: column[others] for name, column in decisions.items()}
        part = scored(batches(states, without, NO_CUTS), LIMITS["paper"], facts(), "drive-2")
        a = campaign(tmp_path / "a", {"drive-1": log(1), "drive-2": log(2)})
        b = campaign(tmp_path / "b", {"drive-1": log(1), "drive-2": part})
        row = find(compare(a, b, resamples=10), "all", "", "egovm", "lon_mae")
        own = metrics_of(log(1))["methods"]["egovm"]["lon"]["mae"]
        assert (row["a"], row["b"]) == pytest.approx((own, own), rel=1e-12)
        assert row["difference"] == row["low"] == row["high"] == 0
        assert find(compare(a, b, resamples=10), "all", "", "fusion", "lon_mae")["difference"] == 0

    def test_logs_of_one_name_must_be_one_log(self, tmp_path: Path) -> None:
        logs = {f"drive-{seed}": log(seed) for seed in range(2)}
        for name, roads in (("a", "1"), ("b", "2")):
            folder = campaign(tmp_path / name, logs)
            names = [{"name": log_name} for log_name in logs]
            (folder / "manifest.json").write_text(json.dumps({"kind": "campaign", "logs": names}))
            run(folder / "drive-0", logs["drive-0"])
            run(folder / "drive-1", logs["drive-1"], roads)
        with pytest.raises(EgolocError, match="1 logs of the same name are not the same log: drive-1"):
            compare(tmp_path / "a", tmp_path / "b", resamples=10)
        assert compare(tmp_path / "a", tmp_path / "a", resamples=10)["pairs"] == 24

    def test_a_campaign_with_one_of_its_logs(self, tmp_path: Path) -> None:
        a = campaign(tmp_path / "a", {f"drive-{seed}": log(seed) for seed in range(3)})
        found = compare(a, run(tmp_path / "b", log(1, 0.5)), resamples=10)
        assert (found["pairs"], found["only_a"], found["only_b"]) == (12, 24, 0)


class TestMistakes:
    def refused(self, capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
        assert main(["compare", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("egoloc: error: ")
        assert error.count("\n") == 1
        return error

    def test_each_has_one_line(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        a = run(tmp_path / "a", log(1))
        assert "nowhere: expected a run folder" in self.refused(capsys, a, tmp_path / "nowhere")
        (tmp_path / "empty").mkdir()
        assert "segments.parquet: missing" in self.refused(capsys, tmp_path / "empty", a)
        highway = run(tmp_path / "highway", log(1, limits=LIMITS["highway"]))
        error = self.refused(capsys, a, highway)
        assert "limits 1.4 m, 0.57 m, 1.5 deg, expected those of" in error
        assert "0.6 m, 0.3 m, 1 deg" in error
        other = run(tmp_path / "other", log(2), identity="2")
        assert "no common segments: expected two runs of the same log" in self.refused(capsys, a, other)
        logs = campaign(tmp_path / "logs", {"drive-7": log(7)})
        assert "no common segments" in self.refused(capsys, logs, a)
        assert "--resamples: expected at least 1, got 0" in self.refused(capsys, a, a, "--resamples", 0)
        assert "--seed: expected 0 or more, got -1" in self.refused(capsys, a, a, "--seed", -1)

    def test_hidden_gnss_in_one_of_them(self, tmp_path: Path) -> None:
        hidden = log(1)
        counts = msgspec.structs.replace(hidden.counts, hidden_length_s=5.0)
        b = run(tmp_path / "b", Sums(counts, hidden.segments, hidden.sketch))
        with pytest.raises(EgolocError, match="expected hidden GNSS in both or in neither"):
            compare(run(tmp_path / "a", log(1)), b)


def made_up_pairs(rng: np.random.Generator, count: int, shift: float) -> Pairs:
    """Segments of 100 epochs whose mean error varies; B's is off by a shift that varies too."""
    sums = np.zeros((2, count, len(METHODS), len(SUMMED)))
    common = rng.gamma(2.0, 0.05, count)
    means = (common, common + shift + rng.normal(0.0, 0.02, count))
    for i, mean in enumerate(means):
        sums[i, :, FUSION, SUMMED.index("lon_count")] = 100.0
        sums[i, :, FUSION, SUMMED.index("lon_abs")] = 100.0 * mean
    return Pairs(count, np.arange(count), np.zeros(count, np.int64), [("", "")], sums, (0, 0))


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """95 % of the time, of 200 times: fewer than 91 % or more than 99 % happen once in a hundred at most."""
    rng = np.random.default_rng(5)
    mae = FIGURES.index("lon_mae")
    held, widths = 0, []
    for trial in range(200):
        low, high = intervals(made_up_pairs(rng, 150, 0.01), 400, trial)["all", ""]
        held += bool(low[FUSION, mae] <= 0.01 <= high[FUSION, mae])
        widths.append(high[FUSION, mae] - low[FUSION, mae])
    assert 0.91 * 200 <= held <= 0.99 * 200
    # as wide as the spread of the mean of 150 paired differences says, not that of the segments themselves
    assert np.median(widths) == pytest.approx(2 * 1.96 * 0.02 / np.sqrt(150), rel=0.1)


def test_resamples_are_sums_of_the_pairs_drawn() -> None:
    """Against the plain way: draw, gather, add."""
    a, b = log(1).segments, log(1, 0.7).segments
    pairs = paired(a, b)
    draws = np.random.default_rng(9)
    plain = []
    for _ in range(100):
        drawn = draws.integers(0, pairs.count, pairs.count)
        both = [sum((pairs.sums[i, pairs.pair == p].sum(axis=0) for p in drawn), np.zeros(1)) for i in range(2)]
        plain.append(figures(both[1]) - figures(both[0]))
    expected: NDArray[np.float64] = np.percentile(np.array(plain)[:, FUSION], (2.5, 97.5), axis=0)
    found = intervals(pairs, 100, 9)["all", ""]
    np.testing.assert_allclose(np.array([end[FUSION] for end in found]), expected, rtol=1e-9, atol=1e-12)


def test_a_slice_that_not_all_resamples_have_uses_those_that_do() -> None:
    made = made_up_pairs(np.random.default_rng(1), 30, 0.01)
    pairs = Pairs(30, made.pair, (made.pair == 29).astype(np.int64), [("", ""), ("tunnel", "")], made.sums, (0, 0))
    low, high = intervals(pairs, 200, 0)["scene", "tunnel"]
    mae = FIGURES.index("lon_mae")
    only = figures(pairs.sums[:, 29])[:, FUSION, mae]
    assert low[FUSION, mae] == pytest.approx(only[1] - only[0])
    assert high[FUSION, mae] == pytest.approx(only[1] - only[0])


def test_a_slice_of_few_pairs_has_no_interval(tmp_path: Path) -> None:
    found = compare(run(tmp_path / "a", log(1, seconds=300.0)), run(tmp_path / "b", log(1, 0.5)), resamples=20)
    assert {(row["low"], row["high"], row["significant"]) for row in found["rows"]} == {(None, None, False)}
    assert find(found, "all", "", "fusion", "lon_mae")["difference"] < 0
    out = io.StringIO()
    print_comparison(found, Console(file=out, width=100, highlight=False))
    assert next(line for line in out.getvalue().splitlines() if "lon m MAE" in line).split()[-2:] == ["-", "-"]


def test_runs_without_scored_epochs_have_no_pairs() -> None:
    nothing = log(1, seconds=0.0).segments
    assert isinstance(nothing, Segments)
    assert paired(nothing, log(1).segments).count == 0


class TestTable:
    def printed(self, found: dict[str, Any]) -> str:
        out = io.StringIO()
        print_comparison(found, Console(file=out, width=100, highlight=False))
        return out.getvalue()

    def test_differences_intervals_and_conditions(self, tmp_path: Path) -> None:
        found = compare(run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1, 0.5)), resamples=200, seed=4)
        text = self.printed(found)
        row = find(found, "all", "", "fusion", "lon_mae")
        line = next(line for line in text.splitlines() if "lon m MAE" in line)
        assert line.split()[-6:] == [
            *(f"{row[key]:.4f}" for key in ("a", "b")),
            *(f"{row[key]:+.4f}" for key in ("difference", "low", "high")),
            "*",
        ]
        mode = next(line for line in text.splitlines() if line.startswith("mode: autonomous"))
        assert mode.split()[2] == "12"
        assert "Equal in every figure: GNSS-RTK, EgoVM." in text
        assert "Over the 12 segments of 60 s that both evaluated; only A: 0, only B: 0" in text
        assert "200 resamples of these pairs (paired bootstrap, seed 4)" in text.replace("\n", " ")

    def test_equal_runs_have_no_table(self, tmp_path: Path) -> None:
        found = compare(run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1)), resamples=10)
        text = self.printed(found)
        assert "Equal in every figure: GNSS-RTK, EgoVM, Fusion." in text
        assert "lon m MAE" not in text

    def test_json(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        a, b = run(tmp_path / "a", log(1)), run(tmp_path / "b", log(1, 0.5))
        assert main(["compare", str(a), str(b), "--resamples", "20", "--seed", "3", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == compare(a, b, 20, 3)
