"""The printed table."""

import io
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from replay.config import HideGnss, RunConfig
from replay.harness import assemble
from replay.hiding import hide_gnss
from replay.table import bench_table, print_run
from tests.replay.drives import decisions, drive


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
    hidden = hide_gnss(log, HideGnss(60.0, 15.0))
    config = RunConfig(hide_gnss=HideGnss(60.0, 15.0))
    done = assemble(hidden.log, config, replace(result, decisions=decisions(hidden.log)), hidden)
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
