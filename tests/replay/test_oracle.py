"""Every figure of small road-test campaigns, worked out a second time from their tables."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from fusion.config import FusionConfig
from replay.batch import Job
from replay.campaign import backend_of, run_campaign
from replay.config import LIMITS, HideGnss, RunConfig
from replay.rescoring import rescore
from replay.sources import parse
from replay.store import Keep
from tests.replay import oracle

LEAST_S = {"plain": 10.0, "hidden": 4.5, "arrival": 10.0}


@pytest.fixture(scope="module", params=LEAST_S)
def campaign(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """Three drives of 1 km, and how much time of a method is evaluated at least, s."""
    run: Path = tmp_path_factory.mktemp(request.param) / "run"
    hide = HideGnss(20.0, 5.0) if request.param == "hidden" else None
    drives = parse("scenario:road-test,drives=3,length_km=1")
    fusion = FusionConfig(order="arrival" if request.param == "arrival" else "stamp")
    run_campaign(drives, run, Job(RunConfig(fusion=fusion, hide_gnss=hide), Keep()), backend_of(len(drives), workers=1))
    return run, LEAST_S[request.param]


def logs_of(run: Path) -> list[Path]:
    return sorted(path for path in run.iterdir() if path.is_dir())


def check_figures(metrics: dict[str, Any], logs: list[Path], least_s: float) -> None:
    limits = tuple(metrics["limits"].values())
    found = {"seconds": metrics["duration_s"], "metres": metrics["distance_m"], **metrics}
    check_same(found, oracle.figures(logs, limits, least_s), "whole")
    for kind, slices in metrics["slices"].items():
        for tag, part in slices.items():
            found = {"seconds": 3600 * part["hours"], "metres": 1000 * part["km"], **part}
            check_same(found, oracle.figures(logs, limits, least_s, kind, tag), f"{kind} {tag}")


def check_same(found: Any, expected: Any, where: str) -> None:
    if not isinstance(expected, dict):
        close = {"rel": 2e-3 if where.endswith(("p50", "p95", "p99")) else 1e-11, "abs": 1e-12}
        assert found == (None if expected is None else pytest.approx(expected, **close)), where
        return
    for key, value in expected.items():
        check_same(found[key], value, f"{where} {key}")


def test_figures_of_a_campaign_and_its_logs_are_those_of_their_tables(campaign: tuple[Path, float]) -> None:
    run, least_s = campaign
    logs = logs_of(run)
    for folder, parts in ((run, logs), *((log, [log]) for log in logs)):
        metrics = json.loads((folder / "metrics.json").read_text())
        assert metrics["methods"]["fusion"]["ar"] is not None
        check_figures(metrics, parts, least_s)


def test_so_they_are_with_other_limits(campaign: tuple[Path, float]) -> None:
    run, least_s = campaign
    metrics = rescore(run, LIMITS["local-street"])
    assert tuple(metrics["limits"].values()) == (0.29, 0.29, 0.5)
    check_figures(metrics, logs_of(run), least_s)


def test_counts_are_those_of_the_tables(campaign: tuple[Path, float]) -> None:
    run, _ = campaign
    metrics = json.loads((run / "metrics.json").read_text())
    decided, excluded, epochs = Counter[tuple[str, str]](), Counter[str](), 0
    for log in logs_of(run):
        table = pq.read_table(log / "decisions.parquet", columns=["sensor", "reason"])
        decided.update(zip(table["sensor"].to_pylist(), table["reason"].to_pylist(), strict=True))
        why = pq.read_table(log / "states.parquet", columns=["excluded"])["excluded"].to_pylist()
        excluded.update(why)
        epochs += len(why)
    told = {(sensor, reason): n for sensor, reasons in metrics["decisions"].items() for reason, n in reasons.items()}
    assert told == decided
    told = {why: n for why, n in metrics["excluded"].items() if not why.endswith("_sigma")}
    assert told == {why: n for why, n in excluded.items() if why not in ("evaluated", "not_hidden")}
    assert metrics["span_s"] == pytest.approx(epochs / 10)
