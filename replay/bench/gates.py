"""`egoloc bench gates`: naive ways of gating beside ours, on drives in which each of them fails.

Every way is a config of the same filter. AR and the largest error are those of a replay's metrics.json, over drives of
seeds that nothing was tuned on.
"""

from collections.abc import Callable
from typing import Any

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table

from fusion.config import FusionConfig, Gates, HealthModel
from fusion.sensor_models import PoseModel
from replay.bench.gate_scenes import DURATION_S, SCENES, Method, informed
from replay.bench.measure import conditions, row
from replay.config import RunConfig
from replay.drive import Drive
from replay.metrics import metrics_of
from replay.scoring import Scorer
from replay.table import bare_table
from sensors.records import Log

FIRST_SEED = 700_000
BLINDFOLDED = PoseModel(
    max_sigma_longitudinal_m=1e6,
    max_sigma_lateral_m=1e6,
    max_sigma_yaw_deg=1e6,
    modes=False,
    sigma_floor_m=0.0,
    sigma_floor_yaw_deg=0.0,
)
"""The fix's covariance as it comes, and no gate on it."""
ALONE = Gates(outvoted=10**9, streak=10**9)
"""Chi-square and nothing else."""


def _naive(pose: PoseModel, gates: Gates, *, careful: bool) -> Method:
    """A way that never starts again either."""
    return Method(FusionConfig(pose=pose, gates=gates, health=HealthModel(restart=False)), careful)


def _ours(**gates: Any) -> Method:
    return Method(FusionConfig(gates=Gates(**gates)))


METHODS = {
    "accept everything": _naive(BLINDFOLDED, msgspec.structs.replace(ALONE, use=False), careful=False),
    "chi-square alone": _naive(BLINDFOLDED, ALONE, careful=False),
    "whole fix rejected": _naive(PoseModel(partial=False), ALONE, careful=True),
    "ours": _ours(),
    "ours, Huber": _ours(robust="huber"),
    "ours, Cauchy": _ours(robust="cauchy"),
}


def run(repeats: int = 5) -> dict[str, Any]:
    """Rows of AR and of the largest horizontal error along an axis, m, over `repeats` seeds of each scene."""
    rows = []
    seeds = range(FIRST_SEED, FIRST_SEED + repeats)
    for name_of_scene, scene in SCENES.items():
        for name, plain in METHODS.items():
            method = informed(scene, plain)
            found = [scored(scene.log(seed, method), method.config) for seed in seeds]
            for metric, values in zip(("ar", "peak_m"), zip(*found, strict=True), strict=True):
                rows.append(row(f"{name_of_scene}: {name}", metric, values))
    stories = {name: scene.story for name, scene in SCENES.items()}
    facts = {"seeds": list(seeds), "duration_s": DURATION_S, "scenes": stories}
    return {"bench": "gates", "rows": rows, "ratios": {}, "conditions": conditions(["numba", "numpy"], **facts)}


def scored(log: Log, config: FusionConfig) -> tuple[float, float]:
    """AR and the largest error along or across the road, m, of a replay."""
    drive = Drive(log, RunConfig(fusion=config), "bench gates")
    batches = [drive.push(log), drive.finish()]
    assert drive.start_ns is not None
    scorer = Scorer(drive.config.limits, log="bench", period_ns=drive.period_ns, start_ns=drive.start_ns)
    for batch in batches:
        scorer.add(batch.states, batch.decisions)
    fusion = metrics_of(scorer.finish(drive.facts(), batches[-1].scenes, batches[-1].modes))["methods"]["fusion"]
    return fusion["ar"], max(fusion[axis]["max"] for axis in ("lon", "lat"))


def table(result: dict[str, Any]) -> RenderableType:
    """Scenes by ways of gating: AR, and the largest error; of the drives the median, and the worst in brackets."""
    rows = {(entry["name"], entry["metric"]): entry for entry in result["rows"]}
    return Group(
        _by_way("AR %, median (worst)", lambda name: _cell(rows[name, "ar"], "min", 100.0, 1)),
        _by_way("largest error m, median (worst)", lambda name: _cell(rows[name, "peak_m"], "max", 1.0, 2)),
    )


def _by_way(title: str, cell: Callable[[str], str]) -> Table:
    """cell: of a row's name."""
    shown = bare_table(2)
    shown.add_column(title)
    for way in METHODS:
        shown.add_column(way, justify="right", no_wrap=True)
    for scene in SCENES:
        shown.add_row(scene, *(cell(f"{scene}: {way}") for way in METHODS))
    return shown


def _cell(entry: dict[str, Any], worst: str, factor: float, digits: int) -> str:
    return f"{factor * entry['median']:.{digits}f} ({factor * entry[worst]:.{digits}f})"
