"""Made-up results of the filter on their way to metrics, as a replay takes real ones."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion.result import Decisions, FusionResult, States
from replay.config import Limits, RunConfig
from replay.evaluation import Batch, Evaluation
from replay.metrics import metrics_of
from replay.run_files import Facts
from replay.scoring import Scorer
from replay.sums import Sums
from sensors.clock import NS_PER_S
from sensors.records import Log
from tests.replay.cutting import joined
from tests.replay.drives import decisions

Columns = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Assembled:
    """The batches of a result, what scoring is told besides, and the metrics with the config's limits."""

    batches: list[Batch]
    facts: Facts
    metrics: dict[str, Any]

    @property
    def states(self) -> Columns:
        return joined(self.batches)[0]

    @property
    def decisions(self) -> Columns:
        return joined(self.batches)[1]

    def sums(self, limits: Limits) -> Sums:
        return _sums(self.batches, self.facts, limits)


def assemble(log: Log, config: RunConfig, result: FusionResult) -> Assembled:
    """What a replay makes of a result. With hidden GNSS the decisions are those on what is left of the log's fixes."""
    evaluation = Evaluation(log.vehicle, config)
    given = evaluation.given(log)
    if config.hide_gnss is not None:
        result = FusionResult(result.states, decisions(given), result.aligned_ns, result.left_out)
    with np.errstate(all="ignore"):
        batches = [evaluation.add(given, result), evaluation.finish(nothing(result.aligned_ns))]
    start_ns = evaluation.first_imu_ns
    assert start_ns is not None
    hide = config.hide_gnss
    facts: Facts = {
        "order": "stamp",
        "period_ns": round(NS_PER_S / config.fusion.output_hz),
        "start_ns": start_ns,
        "alignment_s": None if result.aligned_ns is None else (result.aligned_ns - start_ns) / NS_PER_S,
        "reference": evaluation.reference_facts("log"),
        "hide_gnss": None if hide is None else {"every_s": hide.every_s, "length_s": hide.length_s},
        "stretches": evaluation.stretches,
        "health": {},
        "warnings": [],
        "left_out": [],
    }
    return Assembled(batches, facts, metrics_of(_sums(batches, facts, config.limits)))


def nothing(aligned_ns: int | None) -> FusionResult:
    """A result without rows."""
    none, three, six = np.empty(0), np.empty((0, 3)), np.empty((0, 6, 6))
    t_ns, codes = np.empty(0, np.int64), np.empty(0, np.int8)
    states = States(
        t_ns,
        three,
        three,
        np.empty((0, 4)),
        three,
        three,
        six,
        np.empty((0, 15)),
        codes,
        codes,
        np.empty((0, 5), np.int8),
    )
    decided = Decisions(t_ns, t_ns, codes, t_ns, codes, three, three, none, none, codes, none, none, none)
    return FusionResult(states, decided, aligned_ns)


def _sums(batches: list[Batch], facts: Facts, limits: Limits) -> Sums:
    scorer = Scorer(limits, log="drive", period_ns=facts["period_ns"], start_ns=facts["start_ns"])
    for batch in batches:
        scorer.add(batch.states, batch.decisions)
    return scorer.finish(facts, batches[-1].scenes, batches[-1].modes)
