"""A replay from log to run folder, piece by piece: read, hide, fuse, compare, score, write."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from replay.config import Limits, RunConfig, to_toml
from replay.drive import Drive, read_reference
from replay.metrics import metrics_of
from replay.run_files import read_json
from replay.scoring import Scorer
from replay.sources import LogSource
from replay.store import Keep, check_free, file_hash, load_facts, new_folder, storage, versions, write_json
from replay.tables import Tables, stored_batches, stored_smoothed
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.records import Log
from sensors.simulate.faults.inject import Injector
from sensors.simulate.faults.spec import parse as parse_faults

if TYPE_CHECKING:
    from replay.sums import Sums

Metrics = dict[str, Any]
Progress = Callable[[float], None]


def replay_source(
    source: LogSource,
    out: Path,
    config: RunConfig,
    *,
    reference_file: Path | None = None,
    overwrite: bool = False,
    command: Sequence[str] = (),
    keep: Keep | None = None,
    progress: Progress | None = None,
) -> Metrics:
    """Replay a drive into a run folder, in memory that does not follow its length; returns its metrics.

    reference_file: a trajectory instead of the drive's reference (held whole); command: as typed, for the manifest;
    keep: what of the tables is written (None: all); progress: told after each piece how many km were driven by then.
    Raises EgolocError where nothing can be replayed, StorageError where the folder cannot be written; then nothing is
    left behind.
    """
    keep = keep or Keep()
    check_free(out, overwrite=overwrite)
    if reference_file is not None and config.hide_gnss is not None:
        raise EgolocError("--hide-gnss scores against the hidden fixes: leave out --reference")
    with ThreadPoolExecutor(1) as pool:
        log = pool.submit(source.facts)
        with new_folder(out, overwrite=overwrite) as folder, Tables(folder, source.name, keep) as tables:
            drive, sums = _stream(source, config, reference_file, tables, folder, progress)
            metrics = metrics_of(sums)
            manifest = {
                "name": source.name,
                "log": log.result(),
                "reference_file": reference_file and {"path": str(reference_file), "sha256": file_hash(reference_file)},
                "keep": msgspec.to_builtins(keep),
                "config_sha256": hashlib.sha256(to_toml(drive.config).encode()).hexdigest(),
                "versions": versions(),
                "inject": list(config.inject),
                "seed": config.seed,
                "command": list(command),
                "facts": drive.facts(),
            }
            (folder / "config.toml").write_text(to_toml(drive.config))
            write_json(folder / "manifest.json", manifest)
            write_json(folder / "metrics.json", metrics)
            sums.to_parquet(folder)
    return metrics


def _stream(
    source: LogSource,
    config: RunConfig,
    reference_file: Path | None,
    tables: Tables,
    scratch: Path,
    progress: Progress | None,
) -> tuple[Drive, "Sums"]:
    """Every piece through the filter into the tables, and smoothed at the end; the drive then, and its sums."""
    injector = Injector(parse_faults(config.inject), config.seed, f"{source.where}: --inject")
    pieces = injector.pieces(_pieces(source, config))
    first = next(pieces, Log())
    columns = {"all_columns": tables.holds_decisions}
    drive = Drive(first, config, source.where, reference_file, injector.injections, scratch=scratch, **columns)
    scorer: Scorer | None = None
    for piece in chain((first,), pieces, (None,)):
        batch = drive.finish() if piece is None else drive.push(piece)
        if drive.start_ns is None:
            continue
        scorer = scorer or Scorer(config.limits, log=source.name, period_ns=drive.period_ns, start_ns=drive.start_ns)
        scorer.add(batch.states, batch.decisions)
        tables.add(batch)
        if progress is not None:
            progress(drive.km)
    assert scorer is not None  # a drive without IMU does not come so far
    for rows in drive.smoothed():
        scorer.add_smoothed(rows)
        tables.add_smoothed(rows, batch, drive.config.map_frame)
    return drive, scorer.finish(drive.facts(), batch.scenes, batch.modes)


def _pieces(source: LogSource, config: RunConfig) -> Iterator[Log]:
    """The pieces of a source; what the system says of its file comes as the project's error."""
    try:
        yield from source.pieces(config)
    except OSError as error:
        raise EgolocError(f"{source.where}: cannot be read: {error.strerror or error}") from None


def with_reference(log: Log, path: Path, frame: MapFrame | None) -> Log:
    """The log with a trajectory file as its reference, in a frame or, where none is known, in that of the file."""
    trajectory, placed = read_reference(path, frame, log.vehicle)
    return replace(log, reference=trajectory, map_frame=placed)


def score_run(folder: Path, limits: Limits) -> Metrics:
    """Score a run again from its tables, with other limits; its metrics and sums are replaced."""
    facts = load_facts(folder)
    name = str(read_json(folder / "manifest.json").get("name", folder.resolve().name))
    scorer = Scorer(limits, log=name, period_ns=facts["period_ns"], start_ns=facts["start_ns"])
    for batch in stored_batches(folder):
        scorer.add(batch.states, batch.decisions)
    for rows in stored_smoothed(folder) if facts.get("smoothed") else ():
        scorer.add_smoothed(rows)
    sums = scorer.finish(facts, batch.scenes, batch.modes)
    metrics = metrics_of(sums)
    with storage(folder):
        sums.to_parquet(folder)
        write_json(folder / "metrics.json", metrics)
    return metrics
