"""A replay from log to run folder: read, hide, fuse, compare, score, write."""

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fusion.result import FusionResult
from replay.config import RunConfig, to_toml
from replay.decisions import decision_columns
from replay.hiding import Hidden, hide_gnss
from replay.plausibility import warnings_of
from replay.references import Reference, has_heading
from replay.requirements import NO_POSITIONS, check_replayable
from replay.run_files import Facts, ReferenceFacts
from replay.scoring import score
from replay.states import state_columns
from replay.store import Run, check_free, file_hash, new_folder, versions, write_json, write_tables
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, utm_frame
from sensors.records import LeftOut, Log


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """One replayed log: its tables, metrics and the configuration with the vehicle and map frame that were used."""

    run: Run
    metrics: dict[str, Any]
    config: RunConfig
    result: FusionResult


def replay_file(
    path: Path,
    out: Path,
    config: RunConfig,
    *,
    reference_file: Path | None = None,
    overwrite: bool = False,
    command: Sequence[str] = (),
) -> Replay:
    """Replay an MCAP log into a run folder, and return it.

    reference_file: a trajectory instead of the log's reference; command: as typed, for the manifest. Raises EgolocError
    where nothing can be replayed; then nothing is written.
    """
    from sensors.mcap.io import read_log

    check_free(out, overwrite=overwrite)
    if reference_file is not None and config.hide_gnss is not None:
        raise EgolocError("--hide-gnss scores against the hidden fixes: leave out --reference")
    with ThreadPoolExecutor(1) as pool:
        digest = pool.submit(file_hash, path)
        log = read_log(path, config.topics)
        if reference_file is not None:
            log = with_reference(log, reference_file, config.map_frame or log.map_frame)
        check_replayable(log, str(path))
        log = place(log, config, str(path))
        try:
            done = replay_log(log, config, source=reference_file.name if reference_file else "log")
        except EgolocError as error:
            raise EgolocError(f"{path}: {error}") from None
        manifest = {
            "log": {"path": str(path), "bytes": path.stat().st_size, "sha256": digest.result()},
            "reference_file": reference_file and {"path": str(reference_file), "sha256": file_hash(reference_file)},
            "config_sha256": hashlib.sha256(to_toml(done.config).encode()).hexdigest(),
            "versions": versions(),
            "seed": config.seed,
            "command": list(command),
            "facts": done.run.facts,
        }
    with new_folder(out, overwrite=overwrite) as folder:
        (folder / "config.toml").write_text(to_toml(done.config))
        write_json(folder / "manifest.json", manifest)
        write_json(folder / "metrics.json", done.metrics)
        write_tables(folder, done.run)
    return done


def place(log: Log, config: RunConfig, where: str) -> Log:
    """The log with the config's vehicle and map frame, if any, and a map frame in any case.

    A log without one gets the UTM frame of its first fix, unless it holds map coordinates.
    """
    frame = config.map_frame or log.map_frame
    if frame is None:
        frame = _own_frame(log, where)
    return replace(log, vehicle=config.vehicle or log.vehicle, map_frame=frame)


def with_reference(log: Log, path: Path, frame: MapFrame | None) -> Log:
    """The log with a trajectory file as its reference, in a frame or, where none is known, in that of the file."""
    from sensors.datasets.trajectory_file import read_trajectory

    trajectory, placed = read_trajectory(path, frame)
    return replace(log, reference=trajectory, map_frame=placed)


def _own_frame(log: Log, where: str) -> MapFrame:
    mapped = [name for name, has in (("pose fixes", log.pose_fixes), ("a reference", log.reference)) if has is not None]
    if mapped:
        raise EgolocError(
            f"{where}: {' and '.join(mapped)} in map coordinates: "
            "expected a map frame in the log or [map_frame] in the config"
        )
    if log.gnss is None or not len(log.gnss):
        raise EgolocError(f"{where}: {NO_POSITIONS}")
    try:
        return utm_frame(log.gnss.llh[0])
    except EgolocError as error:
        raise EgolocError(f"{where}: {error}: expected [map_frame] in the config") from None


def replay_log(log: Log, config: RunConfig, *, source: str = "log") -> Replay:
    """Fuse and score a log that knows its map frame. source: where its reference comes from, for the record."""
    from fusion.run import run as fuse

    assert log.map_frame is not None
    hidden = hide_gnss(log, config.hide_gnss) if config.hide_gnss is not None else None
    given = hidden.log if hidden else log
    with np.errstate(all="ignore"):  # what is not finite is said in warnings, not by numpy
        result = fuse(given, config.fusion)
        return assemble(given, config, result, hidden, source)


def assemble(
    log: Log, config: RunConfig, result: FusionResult, hidden: Hidden | None = None, source: str = "log"
) -> Replay:
    """Tables and metrics of a result. log: as the filter got it."""
    assert log.map_frame is not None
    reference = _reference(log, hidden)
    period_ns = round(NS_PER_S / config.fusion.output_hz)
    run = Run(
        states=state_columns(result, log, log.map_frame, reference, period_ns),
        decisions=decision_columns(result.decisions, log, log.map_frame, reference, hidden.rows if hidden else {}),
        facts=_facts(log, config, result, reference, source),
    )
    used = msgspec.structs.replace(config, vehicle=log.vehicle, map_frame=log.map_frame)
    return Replay(run, score(run, config.limits), used, result)


def _reference(log: Log, hidden: Hidden | None) -> Reference | None:
    if log.reference is None or not len(log.reference):
        return None
    if hidden is not None:
        return Reference(log.reference, log.vehicle.gnss_lever_arm, hidden.stretches)
    return Reference(log.reference, log.vehicle.reference_lever_arm)


def _facts(log: Log, config: RunConfig, result: FusionResult, reference: Reference | None, source: str) -> Facts:
    """What scoring must know besides the tables."""
    assert log.imu is not None
    start_ns = int(log.imu.t_ns[0])
    aligned = None if result.aligned_ns is None else (result.aligned_ns - start_ns) / NS_PER_S
    stretches = None if reference is None or reference.stretches is None else reference.stretches.tolist()
    return {
        "order": "stamp",
        "period_ns": round(NS_PER_S / config.fusion.output_hz),
        "start_ns": start_ns,
        "alignment_s": aligned,
        "reference": _describe(reference, source),
        "hide_gnss": None if config.hide_gnss is None else msgspec.to_builtins(config.hide_gnss),
        "stretches": stretches,
        "warnings": warnings_of(result, log),
        "left_out": _left_out((*log.left_out, *result.left_out)),
    }


def _describe(reference: Reference | None, source: str) -> ReferenceFacts:
    if reference is None:
        return {"kind": None, "source": None, "heading": None}
    kind = "odometry" if reference.stretches is None else "hidden gnss"
    return {"kind": kind, "source": source, "heading": "attitude" if has_heading(reference.trajectory) else "course"}


def _left_out(entries: Sequence[LeftOut]) -> list[dict[str, str | int]]:
    return [{"source": entry.source, "reason": entry.reason, "count": entry.count} for entry in entries]
