"""The printed table."""

import io
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from replay import metrics as scores
from replay.config import HideGnss, RunConfig
from replay.paper import TABLE_5, paper_table
from replay.sums import merge
from replay.table import bench_table, print_run
from sensors.records import Tags
from tests.replay.assembling import Assembled, assemble
from tests.replay.drives import START_NS, drive


def printed(metrics: dict[str, Any], width: int) -> str:
    out = io.StringIO()
    print_run(metrics, Console(file=out, width=width, highlight=False))
    return out.getvalue()


def metrics_of(**kind: Any) -> dict[str, Any]:
    log, result = drive(60.0, state_error=(0.05, -0.02, 0.002), pose_error=(0.12, 0.25, -0.005), **kind)
    return assemble(log, RunConfig(), result).metrics


def row(text: str, method: str, nth: int = 0) -> list[str]:
    return [line.split() for line in text.splitlines() if line.startswith(method)][nth]


def test_methods_stand_side_by_side() -> None:
    text = printed(metrics_of(aligned_s=15.0), 132)
    assert row(text, "GNSS-RTK") == [
        "GNSS-RTK",
        *["100"] * 2,
        *["0.000"] * 2,
        *["100"] * 3,
        *["0.000"] * 2,
        *["100"] * 3,
        *"-----",
    ]
    assert row(text, "EgoVM")[3:13] == ["0.120", "0.120", "0.0", "100", "100", "0.250", "0.250", "0.0", "0.0", "100"]
    fusion = row(text, "Fusion")
    assert fusion[:8] == ["Fusion", "75.13", "75.1", "0.050", "0.050", "100", "100", "100"]
    assert fusion[-5:] == ["0.115", "0.115", "0.0", "100", "100"]
    assert "GNSS-RTK does not estimate yaw: its AR is that of the other axes." in text
    assert "Scored: 599 epochs, 59.9 s, 0.599 km against odometry" in text
    assert "Aligned 15.0 s after the first IMU sample." in text


@pytest.mark.parametrize("width", [80, 100, 132])
def test_nothing_is_cut_off(width: int) -> None:
    text = printed(metrics_of(), width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    cells = row(text, "Fusion") + (row(text, "Fusion", 1)[1:] if width < 120 else [])
    assert len(cells) == 18


def test_what_is_not_evaluated_is_no_number() -> None:
    text = printed(metrics_of(with_reference=False), 132)
    assert row(text, "Fusion") == ["Fusion", *["-"] * 17]
    assert "Not evaluated: the log has no reference (see --reference and --hide-gnss)." in text


def test_a_share_short_of_the_whole_is_not_printed_as_100() -> None:
    metrics = metrics_of()
    metrics["methods"]["fusion"] |= {"ar": 0.999999, "coverage": 0.99999}
    assert row(printed(metrics, 132), "Fusion")[1:3] == ["99.99", "99.9"]


def test_exclusions_and_left_out_rows_are_counted() -> None:
    metrics = metrics_of() | {
        "excluded": {"gap": 7, "slow": 3},
        "left_out": [
            {"source": "/imu", "reason": "stamp repeats", "count": 2},
            {"source": "/gps", "reason": "no messages", "count": 0},
        ],
    }
    text = printed(metrics, 132)
    assert "Excluded: 7 epochs: in a gap of the reference." in text
    assert "Excluded: 3 epochs: the reference has no heading and moves below 1 m/s." in text
    assert "Left out: 2 of /imu: stamp repeats." in text
    assert "Left out: /gps: no messages." in text


def test_hidden_stretches_have_a_line_each() -> None:
    log, result = drive(200.0, with_reference=False, state_error=(0.3, 0.4, 0.0))
    done = assemble(log, RunConfig(hide_gnss=HideGnss(60.0, 15.0)), result)
    text = printed(done.metrics, 80)
    assert row(text, "      120.0") == ["120.0", "0.500", "0.141", "3.54", "15.0"]
    assert "Horizontal error at the end of 3 stretches of 15 s: median 0.500 m" in text.replace("\n", " ")
    assert "Yaw is not scored: the reference has no heading" in text


def test_a_benchmark_says_how_many_times_faster() -> None:
    row_of = {"metric": "messages_per_s", "min": 1.0, "max": 3.0}
    result = {
        "rows": [{"name": "egoloc", "median": 2_000_000.0, **row_of}, {"name": "peer", "median": 31_000.0, **row_of}],
        "ratios": {"peer": 64.5},
    }
    out = io.StringIO()
    Console(file=out, width=100).print(bench_table(result))
    assert row(out.getvalue(), "egoloc") == ["egoloc", "messages_per_s", "2e+06", "1", "3"]
    assert row(out.getvalue(), "peer")[-1] == "64.5"


def tagged() -> Assembled:
    """Twenty seconds of city, then forty of tunnel and night; autonomous throughout."""
    log, result = drive(60.0, state_error=(0.05, -0.02, 0.002), pose_error=(0.12, 0.35, -0.005))
    t_ns = START_NS + np.array([0, 20_000_000_000])
    mode = Tags(t_ns[:1], t_ns[:1], np.array(["autonomous"]))
    log = replace(log, scene=Tags(t_ns, t_ns, np.array(["city", "tunnel,night"])), mode=mode)
    return assemble(log, RunConfig(), result)


def test_hidden_stretches_of_a_campaign_name_their_logs() -> None:
    log, result = drive(200.0, state_error=(0.3, 0.4, 0.0), with_reference=False)
    sums = assemble(log, RunConfig(hide_gnss=HideGnss(60.0, 15.0)), result).sums(RunConfig().limits)
    logs = {"total": 2, "done": 2, "failed": []}
    lines = printed(scores.metrics_of(merge([("drive-a", sums), ("drive-b", sums)]), logs), 80).splitlines()
    found = [line.split()[:3] for line in lines if line.startswith("drive-")]
    starts = ("60.0", "120.0", "180.0")
    assert found == [[name, start, "0.500"] for name in ("drive-a", "drive-b") for start in starts]


@pytest.mark.parametrize("width", [80, 132])
def test_slices_have_exposure_and_a_line_a_method(width: int) -> None:
    text = printed(tagged().metrics, width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    lines = [line.split() for line in text.splitlines()]
    assert [line[:6] for line in lines if line[:1] in (["city"], ["tunnel"], ["night"])] == [
        ["city", "GNSS-RTK", "0.006", "0.20", "100", "100"],
        *([tag, "GNSS-RTK", "0.011", "0.40", "100", "100"] for tag in ("night", "tunnel")),
    ]
    assert [line[:3] for line in lines if line[:1] == ["mode:"]] == [["mode:", "autonomous", "GNSS-RTK"]]
    errors = ["0.120", "0.120", "0.350", "0.350", "0.286", "0.286"] if width > 100 else ["0.120", "0.350", "0.286"]
    assert lines.count(["EgoVM", "0.00", "100", *errors]) == 4


def campaign(*failed: dict[str, str]) -> dict[str, Any]:
    sums = tagged().sums(RunConfig().limits)
    lost = [{"kind": "lost", "text": "The filter lost track."}]
    counts = msgspec.structs.replace(sums.counts, warnings=lost, warning_counts={"lost": 1})
    logs = {"total": 60 + len(failed), "done": 60, "failed": list(failed)}
    return scores.metrics_of(merge((f"drive-{i:02d}", replace(sums, counts=counts)) for i in range(60)), logs)


def test_a_campaign_says_how_many_logs_and_how_far() -> None:
    text = printed(campaign(), 132)
    assert "Logs: 60 of 60." in text
    assert row(text, "EgoVM")[:3] == ["EgoVM", "0.000", "100"]
    assert "Scored: 35940 epochs, 3594.0 s, 35.9" in text
    assert row(text, "Fusion")[:4] == ["Fusion", "100", "100", "0.050"]
    assert text.count("The filter lost track.") == 3
    assert "WARNING: lost: 60 of 60 logs" in text
    assert "WARNING:   drive-00: The filter lost track." in text
    assert "Aligned 0.0 s after the first IMU sample, the slowest log." in text


def test_a_campaign_says_how_many_logs_failed() -> None:
    text = printed(campaign({"log": "broken", "error": "broken.mcap: no messages"}), 132)
    assert "Logs: 60 of 61; 1 failed and are not in these figures." in text


def test_long_drives_are_told_in_hours() -> None:
    text = printed(tagged().metrics | {"epochs": 19_800_000, "duration_s": 1_980_000.0, "distance_m": 16.5e6}, 132)
    assert "Scored: 19,800,000 epochs, 550.00 h, 16,500.0 km against odometry" in text


PAPER_ROWS = """
GNSS-RTK&93.67%&0.132&1.082&91.41/93.33/94.12&0.122&0.950&91.26/93.63/94.54&-&-&-/-/-
EgoVM&99.82%&0.037&0.104&96.99/99.66/99.77&0.026&0.035&98.54/99.93/99.99&0.131&0.506&42.49/96.29/99.75
Fusion&100.00%&0.030&0.040&97.80/99.84/99.96&0.026&0.036&97.90/99.89/100.00&0.122&0.192&44.41/97.31/99.74
"""


class TestPaper:
    def printed(self, metrics: dict[str, Any], width: int = 132) -> str:
        out = io.StringIO()
        Console(file=out, width=width, highlight=False).print(paper_table(metrics, width))
        return out.getvalue()

    def test_the_papers_rows(self) -> None:
        """Against the lines of its Table 5 (LaTeX source of the paper)."""
        text = self.printed(tagged().metrics)
        found = [
            line.split("paper")[1].split() for line in text.splitlines() if " paper " in line and "Table" not in line
        ]
        for cells, line in zip(found, PAPER_ROWS.strip().splitlines(), strict=True):
            plain = line.replace("&", " ").replace("/", " ").replace("%", "").replace("100.00", "100")
            assert cells == plain.split()[1:]

    @pytest.mark.parametrize("width", [80, 100, 131])
    def test_nothing_is_cut_off_on_a_narrow_terminal(self, width: int) -> None:
        metrics = tagged().metrics
        narrow, wide = self.printed(metrics, width), self.printed(metrics)
        assert "…" not in narrow
        assert max(map(len, narrow.splitlines())) <= width
        below = [line.split("here")[1].split() for line in narrow.splitlines() if " here " in line]
        beside = [line.split("here")[1].split() for line in wide.splitlines() if " here " in line]
        assert [
            [*lon, *lat, *yaw] for lon, lat, yaw in zip(*(below[i : i + 3] for i in (0, 3, 6)), strict=True)
        ] == beside

    def test_ours_stand_below(self) -> None:
        text = self.printed(tagged().metrics)
        ours = [line.split() for line in text.splitlines() if line.split()[:1] == ["here"]]
        assert len(ours) == len(TABLE_5)
        assert ours[1][:4] == ["here", "0.00", "0.120", "0.120"]
        assert "EgoVM paper, Table 5 (16,500 km on roads), and this simulation (1 km)" in text

    def test_a_method_without_data_has_dashes(self) -> None:
        metrics = tagged().metrics
        del metrics["methods"]["gnss"]
        ours = [line.split() for line in self.printed(metrics).splitlines() if line.split()[:1] == ["here"]]
        assert ours[0] == ["here", *["-"] * 16]
