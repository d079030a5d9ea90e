"""Whether a run folder already holds what the replay of a log would write."""

from pathlib import Path
from typing import Any

import msgspec

from replay.batch import Job
from replay.config import RunConfig, load_config
from replay.run_files import EXPECTED, read_json
from replay.sources import LogSource
from replay.store import file_hash, versions
from replay.sums import Sums
from sensors.errors import EgolocError


def why_not_finished(folder: Path, source: LogSource, job: Job) -> str | None:
    """What keeps the folder from being taken as it is; None: nothing.

    Read back: manifest, configuration, metrics and sums; of the tables only how many rows they hold.
    """
    try:
        return _difference(folder, source, job) or _damage(folder, job.config)
    except (EgolocError, OSError) as error:
        return str(error)


def reference_facts(path: Path | None) -> dict[str, str] | None:
    """What manifests say of a reference file."""
    return None if path is None else {"path": str(path), "sha256": file_hash(path)}


def _difference(folder: Path, source: LogSource, job: Job) -> str | None:
    """In what the run is not the one that is asked for."""
    manifest = read_json(folder / "manifest.json")
    used = load_config(folder / "config.toml")  # complete, with the vehicle and the map frame of the log
    asked: dict[str, tuple[Any, Any]] = {
        "log": (manifest.get("log"), source.facts()),
        "configuration": (
            msgspec.structs.replace(used, vehicle=job.config.vehicle, map_frame=job.config.map_frame),
            job.config,
        ),
        "reference": (manifest.get("reference_file"), reference_facts(job.reference_file)),
        "--states-hz and --decisions": (manifest.get("keep"), msgspec.to_builtins(job.keep)),
        "versions of libraries": (manifest.get("versions"), versions()),
    }
    other = [what for what, (found, wanted) in asked.items() if found != wanted]
    return f"{folder}: a run with other {', '.join(other)}" if other else None


def _damage(folder: Path, config: RunConfig) -> str | None:
    """What cannot be read of the run, or was changed since."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    read_json(folder / "metrics.json")
    if Sums.from_parquet(folder).counts.limits != config.limits:
        return f"{folder}: scored again with other limits"
    for name in ("states.parquet", "decisions.parquet", *(["smoothed.parquet"] if config.smooth else [])):
        if not (folder / name).is_file():
            return f"{folder / name}: missing: {EXPECTED}"
        try:
            pq.read_metadata(folder / name)
        except (pa.ArrowException, OSError) as error:
            return f"{folder / name}: expected a Parquet file: {str(error).splitlines()[0]}"
    return None
