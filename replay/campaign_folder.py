"""The folder of a campaign: made new, taken up again or refused; one process at a time writes there."""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from replay.config import RunConfig, to_toml
from replay.run_files import read_json
from replay.sources import BESIDE, ERROR, RECORDING
from replay.store import FILES, check_free, storage, write_json
from sensors.errors import EgolocError

KIND = "campaign"
LOCK = ".lock"
LEFTOVER = re.compile(r"\..*\.(tmp|old)")
"""What only a process that died leaves: files and folders are written under such names and renamed."""
SAME = {
    "logs": "logs",
    "config_sha256": "configuration",
    "reference_file": "reference",
    "keep": "--states-hz and --decisions",
    "versions": "versions of libraries",
}
"""Keys of the manifest that a campaign must go on with, and what messages call them."""


def error_file(folder: Path, log: str) -> Path:
    """Where the error of a log that failed is written in full."""
    return folder / f"{log}{ERROR}"


def is_campaign(folder: Path) -> bool:
    """Whether a campaign was begun in a folder."""
    path = folder / "manifest.json"
    return path.is_file() and read_json(path).get("kind") == KIND


def log_names(folder: Path) -> list[str]:
    """Names of a campaign's logs."""
    return [entry["name"] for entry in read_json(folder / "manifest.json").get("logs", ())]


@contextmanager
def campaign_folder(
    out: Path, manifest: Mapping[str, Any], config: RunConfig, *, resume: bool, overwrite: bool
) -> Iterator[dict[str, Any]]:
    """The folder for the time of the block, locked; yields the manifest of the campaign as it was begun.

    After ``check_place``. Raises EgolocError where a campaign of other logs or settings stands there.
    """
    with storage(out):
        out.mkdir(parents=True, exist_ok=resume or overwrite)
    with _locked(out):
        with storage(out):
            begun = _begun(out, manifest, resume=resume)
            if begun is None:
                _clear(out)
                (out / "config.toml").write_text(to_toml(config))
                write_json(out / "manifest.json", manifest)
            _clear_leftovers(out)
        try:
            yield dict(manifest if begun is None else begun)
        finally:
            with suppress(OSError):  # the folder may be gone
                _clear_leftovers(out)


def check_place(out: Path, *, resume: bool, overwrite: bool) -> None:
    """Raise EgolocError where nothing can be begun, nor gone on with."""
    if not (out.exists() or out.is_symlink()):
        check_free(out)
    elif not (resume or overwrite):
        raise EgolocError(f"{out}: {_what_is_there(out)}")
    elif not out.is_dir():
        raise EgolocError(f"{out}: expected a folder of a campaign")


def _begun(out: Path, manifest: Mapping[str, Any], *, resume: bool) -> dict[str, Any] | None:
    """The manifest of the campaign to go on with; None: none was begun, or it is to be replaced."""
    if not resume or _is_bare(out):
        return None
    if not is_campaign(out):
        raise EgolocError(f"{out}: --resume: expected the folder of a campaign of several logs, found something else")
    begun = read_json(out / "manifest.json")
    for key, what in SAME.items():
        if begun.get(key) != manifest[key]:
            raise EgolocError(
                f"{out}: --resume: expected the {what} that it was begun with{_difference(key, begun, manifest)}: "
                "choose another --out or replace it with --overwrite"
            )
    return begun


def _what_is_there(out: Path) -> str:
    """Why nothing new is begun in a folder."""
    if not (out / "manifest.json").is_file():
        return "exists already: expected another --out"
    if is_campaign(out):
        return "exists already: expected --resume, --overwrite or another --out"
    return "is a run folder: expected --overwrite, or another --out to hold the runs of several logs"


def _is_bare(out: Path) -> bool:
    """Whether a process died here before it had written the manifest."""
    return all(path.name in {LOCK, "config.toml"} or LEFTOVER.fullmatch(path.name) for path in out.iterdir())


def _difference(key: str, begun: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """A few words on what differs."""
    if key == "logs":
        old, new = ([entry["where"] for entry in manifest.get(key, ())] for manifest in (begun, now))
        if len(old) != len(new):
            return f" ({len(old)}, got {len(new)})"
        first = next(((a, b) for a, b in zip(old, new, strict=True) if a != b), None)
        return f" ({first[0]}, got {first[1]})" if first else ""
    if key == "versions":
        old_versions, new_versions = begun.get(key, {}), now[key]
        found = [
            f"{name} {old_versions.get(name)}, got {new}"
            for name, new in new_versions.items()
            if new != old_versions.get(name)
        ]
        return f" ({'; '.join(found)})"
    if key == "keep":
        return f" ({_kept(begun.get(key))}, got {_kept(now[key])})"
    return ""


def _kept(keep: Any) -> str:
    """What a manifest says of the tables that are written, in the words of the options."""
    if not isinstance(keep, dict):
        return json.dumps(keep)
    hz = keep.get("states_hz")
    return f"{'all' if hz is None else hz} and {keep.get('decisions')}"


def _clear(out: Path) -> None:
    """Remove what is to be replaced: a campaign or a run, and nothing of anyone else's."""
    logs = log_names(out) if is_campaign(out) else []
    known = BESIDE | FILES | {LOCK, *logs, *(error_file(out, log).name for log in logs)}
    found = [path for path in out.iterdir() if not LEFTOVER.fullmatch(path.name)]
    if any(path.name not in known and path.suffix != RECORDING for path in found):
        raise EgolocError(f"{out}: --overwrite replaces run folders only, and this is none or holds other files")
    for log in logs:
        check_free(out / log, overwrite=True)
    for path in found:
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _clear_leftovers(out: Path) -> None:
    for path in out.iterdir():
        if LEFTOVER.fullmatch(path.name):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes out; the system lifts the lock when this one ends, however it ends."""
    import fcntl

    path = folder / LOCK
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held = path.exists() and os.path.samestat(os.fstat(descriptor), path.stat())
        except BlockingIOError:
            held = False
        if not held:  # or its holder removed it a moment ago
            raise EgolocError(f"{folder}: another egoloc replay is at work there")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(descriptor)
