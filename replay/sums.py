"""Everything that metrics.json needs of a log, as sums that add up over logs: the record, its files, and merging.

The way of the numbers, the same for a log and a campaign: scoring.Scorer -> Sums -> (merge ->) metrics.metrics_of.
Integers add exactly; floats are kept per segment and summed with math.fsum at the very end, so that neither order nor
grouping ever changes a digit.

    scorer = Scorer(limits, log=name, period_ns=period_ns, start_ns=first_imu_ns)
    scorer.add(states, decisions)                      # per batch, in time order
    sums = scorer.finish(facts, scenes, modes)         # the lists that the codes of `scene` and `mode` index
    sums.to_parquet(folder)                            # segments.parquet, percentiles.parquet
    write_json(folder / "metrics.json", metrics_of(sums))

    whole = merge((name, Sums.from_parquet(run / name)) for name in names)
    whole.to_parquet(run)
    metrics_of(whole, logs={"total": .., "done": .., "failed": [{"log": .., "error": ..}]})
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import msgspec

from fusion.result import Reason, Sensor
from replay.arrow import read_columns
from replay.config import Limits
from replay.run_files import ReferenceFacts
from replay.segments import NUMBERS, TEXTS, Segments, joined
from replay.sketch import Histograms, Sketch
from sensors.errors import EgolocError

SEGMENTS, PERCENTILES = "segments.parquet", "percentiles.parquet"
EXAMPLES = 20
"""Warnings of a kind that a campaign names; all are counted."""
MIXED = "mixed"
"""What a campaign says of its reference where its logs differ."""
_KEY = b"egoloc"
_FORMAT = 1


class Counts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is counted over a whole log; kept as JSON in the metadata of segments.parquet."""

    limits: Limits
    order: str
    reference: ReferenceFacts
    span_ns: int
    """Epochs of the output grid times its period."""
    alignment_s: float | None
    """Of several logs: the longest; None: none ever aligned."""
    excluded: dict[str, int]
    decisions: dict[str, dict[str, int]]
    hidden_length_s: float | None
    """Planned length of a hidden stretch; None: nothing was hidden."""
    stretches: list[dict[str, Any]]
    warnings: list[dict[str, str]]
    warning_counts: dict[str, int]
    left_out: list[dict[str, Any]]
    smoothed: bool = False
    """Whether the drive was smoothed as well; of several logs: any."""
    format: int = _FORMAT
    health: dict[str, int] = {}
    """Epochs by state of health (and "state/cause"), and restarts (``replay.health``)."""
    estimates: list[dict[str, Any]] = []
    """What a log showed of the calibration (``fusion.calibration``); of several logs: nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """One log, or several merged."""

    counts: Counts
    segments: Segments
    sketch: Sketch

    def to_parquet(self, folder: Path) -> None:
        """Write segments.parquet and percentiles.parquet into a folder; others there stay until both are whole."""
        import pyarrow.parquet as pq

        table = self.segments.to_arrow().replace_schema_metadata({_KEY: msgspec.json.encode(self.counts)})
        options = {"compression": "zstd", "use_dictionary": list(TEXTS), "write_statistics": False}
        with TemporaryDirectory(prefix=".", suffix=".tmp", dir=folder) as beside:
            pq.write_table(table, Path(beside) / SEGMENTS, write_page_checksum=True, **options)
            self.sketch.write(Path(beside) / PERCENTILES)
            for name in (SEGMENTS, PERCENTILES):
                (Path(beside) / name).replace(folder / name)

    @classmethod
    def from_parquet(cls, folder: Path) -> Self:
        """The sums in a run folder; EgolocError names the file that is missing or damaged."""
        counts, segments = read_segments(folder)
        return cls(counts, segments, Sketch.read(folder / PERCENTILES))


def read_segments(folder: Path) -> tuple[Counts, Segments]:
    """The counts and segments of a run folder, without its percentiles."""
    path = folder / SEGMENTS
    table = read_columns(path, TEXTS, NUMBERS)
    try:
        counts = msgspec.json.decode((table.schema.metadata or {}).get(_KEY, b"{}"), type=Counts)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise EgolocError(f"{path}: metadata {_KEY.decode()}: {error}") from None
    return counts, Segments.from_arrow(table)


def merge(parts: Iterable[tuple[str, Sums]]) -> Sums:
    """The sums of several logs, each under the name given with it; their order does not matter."""
    known: dict[str, tuple[Counts, Segments]] = {}
    histograms = Histograms()
    for name, part in parts:
        known[name] = part.counts, part.segments
        histograms.join(part.sketch)
    known = dict(sorted(known.items()))
    segments = joined([(name, table) for name, (_, table) in known.items()])
    return Sums(_merged_counts({name: counts for name, (counts, _) in known.items()}), segments, histograms.sketch())


def _merged_counts(parts: Mapping[str, Counts]) -> Counts:
    """Counts added up, what is told of single logs with their names."""
    every = list(parts.values())
    if not every:
        raise EgolocError("merge: expected at least one log")
    first = every[0]
    differing = [name for name, counts in parts.items() if counts.limits != first.limits or counts.order != first.order]
    if differing:
        raise EgolocError(f"{differing[0]}: expected the limits and order of {next(iter(parts))}, got others")
    aligned = [counts.alignment_s for counts in every if counts.alignment_s is not None]
    hidden = [counts.hidden_length_s for counts in every if counts.hidden_length_s is not None]
    warnings = Counter[str]()
    for counts in every:
        warnings.update(counts.warning_counts)
    return Counts(
        limits=first.limits,
        order=first.order,
        reference=_reference([counts.reference for counts in every]),
        span_ns=sum(counts.span_ns for counts in every),
        alignment_s=max(aligned, default=None),
        excluded=_added([counts.excluded for counts in every]),
        decisions=_added_decisions(every),
        hidden_length_s=max(hidden, default=None),
        stretches=[{"log": name, **stretch} for name, counts in parts.items() for stretch in counts.stretches],
        warnings=_examples(parts),
        warning_counts=dict(sorted(warnings.items())),
        left_out=_left_out(parts),
        health=_added([counts.health for counts in every]),
        smoothed=any(counts.smoothed for counts in every),
    )


def _reference(parts: Sequence[ReferenceFacts]) -> ReferenceFacts:
    """What all logs that say anything say."""

    def common(values: Iterable[str | None]) -> str | None:
        said = {value for value in values if value is not None}
        return MIXED if len(said) > 1 else next(iter(said), None)

    return {
        "kind": common(part["kind"] for part in parts),
        "source": common(part["source"] for part in parts),
        "heading": common(part["heading"] for part in parts),
    }


def _added(parts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    total = Counter[str]()
    for part in parts:
        total.update(part)
    return dict(sorted(total.items()))


def _added_decisions(parts: Sequence[Counts]) -> dict[str, dict[str, int]]:
    """Sensor -> reason -> measurements, in the order of Sensor and Reason."""
    total: dict[str, Counter[str]] = {}
    for part in parts:
        for sensor, reasons in part.decisions.items():
            total.setdefault(sensor, Counter()).update(reasons)
    names, reasons_ = ([member.name.lower() for member in kind] for kind in (Sensor, Reason))
    return {s: {r: total[s][r] for r in reasons_ if total[s][r]} for s in names if s in total}


def _examples(parts: Mapping[str, Counts]) -> list[dict[str, str]]:
    """Warnings with the names of their logs, at most EXAMPLES of a kind, by kind."""
    found: dict[str, list[dict[str, str]]] = {}
    for name, counts in parts.items():
        for entry in counts.warnings:
            of_kind = found.setdefault(entry["kind"], [])
            if len(of_kind) < EXAMPLES:
                of_kind.append({**entry, "log": entry.get("log", name)})
    return [entry for kind in sorted(found) for entry in found[kind]]


def _left_out(parts: Mapping[str, Counts]) -> list[dict[str, Any]]:
    """Rows left out by source and reason; a source that bears the log's name is the log's file."""
    total: Counter[tuple[str, str]] = Counter()
    for name, counts in parts.items():
        for entry in counts.left_out:
            source = "log file" if Path(entry["source"]).stem == name else entry["source"]
            total[source, entry["reason"]] += entry["count"]
    return [{"source": s, "reason": r, "count": count} for (s, r), count in sorted(total.items())]
