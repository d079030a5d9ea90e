"""A run or a campaign scored again from its tables, for instance with other limits; nothing is filtered."""

from collections.abc import Callable
from pathlib import Path

from replay.campaign_folder import is_campaign, log_names
from replay.config import Limits, load_config
from replay.harness import score_run
from replay.metrics import Metrics, metrics_of
from replay.run_files import read_json
from replay.store import load_facts, storage, write_json
from replay.sums import Sums, merge
from sensors.errors import EgolocError


def rescore(folder: Path, limits: Limits | None = None, tell: Callable[[str], None] = lambda _: None) -> Metrics:
    """Score a run or each log of a campaign again, replace its metrics and sums, and return the metrics.

    limits: None for those of the run's config.toml; tell: hears which log is in work. Raises EgolocError, before
    anything is replaced, where a run's tables were thinned. Memory does not follow the length of logs.
    """
    if not is_campaign(folder):
        return _one(folder, limits)
    logs = _finished(folder)
    failed = {entry["log"] for entry in logs["failed"]}
    names = [name for name in log_names(folder) if name not in failed]
    for name in names:
        load_facts(folder / name)
    for done, name in enumerate(names, start=1):
        tell(f"{name} ({done} of {len(names)})")
        _one(folder / name, limits)
    whole = merge((name, Sums.from_parquet(folder / name)) for name in names)
    metrics = metrics_of(whole, logs)
    with storage(folder):
        whole.to_parquet(folder)
        write_json(folder / "metrics.json", metrics)
    return metrics


def _one(folder: Path, limits: Limits | None) -> Metrics:
    load_facts(folder)
    return score_run(folder, limits or load_config(folder / "config.toml").limits)


def _finished(folder: Path) -> Metrics:
    """What metrics.json says of a campaign's logs."""
    path = folder / "metrics.json"
    if not path.is_file():
        raise EgolocError(f"{path}: missing: the campaign is not finished: go on with egoloc replay --resume")
    logs = read_json(path).get("logs")
    if not isinstance(logs, dict) or not isinstance(logs.get("failed"), list):
        raise EgolocError(f"{path}: logs: expected an object with the key failed")
    return logs
