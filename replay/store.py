"""The run folder: written whole to a temporary name and then renamed; read back for scoring."""

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import msgspec

from replay.run_files import EXPECTED, Facts, Manifest, checked, read_json
from sensors.bounds import NonNegative
from sensors.errors import EgolocError

FILES = {
    *("config.toml", "manifest.json", "metrics.json", "states.parquet", "decisions.parquet"),
    *("smoothed.parquet", "segments.parquet", "percentiles.parquet", "report.html"),
}
"""What may stand in a run folder, besides recordings."""
VERSIONED = ("egoloc", "numpy", "numba", "scipy", "pyarrow", "pymap3d", "pyproj", "mcap")


class StorageError(EgolocError):
    """A run folder cannot be written: the disk is full, gone or read-only. Nothing is wrong with the log."""


class Keep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What of a replay's tables is written; everything is scored first."""

    states_hz: NonNegative | None = None
    """States on multiples of 1/states_hz s of Unix time, 1/s; None: all, 0: none."""
    decisions: Literal["all", "rejected", "none"] = "all"
    """rejected: measurements that were not applied."""

    @property
    def everything(self) -> bool:
        """Whether the run can be scored again."""
        return self.states_hz is None and self.decisions == "all"


@contextmanager
def storage(out: Path) -> Iterator[None]:
    """What the system says against writing `out` in the block, as StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{out}: cannot be written: {_reason(error)}") from None


@contextmanager
def new_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that becomes `out` when the block ends well and vanishes when it does not.

    Only a run folder is ever overwritten. Raises StorageError for any OSError.
    """
    check_free(out, overwrite=overwrite)
    above = [parent for parent in out.absolute().parents if not parent.exists()]
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with storage(out):
            temporary.mkdir(parents=True)
            yield temporary
            if out.exists():
                old = out.with_name(f".{out.name}.{os.getpid()}.old")
                out.rename(old)
                temporary.rename(out)
                shutil.rmtree(old)
            else:
                temporary.rename(out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with suppress(OSError):  # all that hold nothing
            for folder in above:
                folder.rmdir()


def clear_leftovers(out: Path) -> None:
    """Remove what a process that died has left of writing `out`; none may be at it now."""
    leftover = re.compile(rf"\.{re.escape(out.name)}\.\d+\.(tmp|old)")
    for path in out.parent.iterdir() if out.parent.is_dir() else ():
        if leftover.fullmatch(path.name):
            shutil.rmtree(path, ignore_errors=True)


def _reason(error: OSError) -> str:
    """The system's words alone: Arrow wraps them into its own."""
    return os.strerror(error.errno) if error.errno else str(error)


def check_free(out: Path, *, overwrite: bool = False) -> None:
    """Raise EgolocError unless a run folder can be written at `out`."""
    if not out.exists() and not out.is_symlink():
        _check_place(out)
        return
    if not overwrite:
        raise EgolocError(f"{out}: exists already: choose another --out or add --overwrite")
    strange = out.is_symlink() or not out.is_dir() or {p.name for p in out.iterdir() if p.suffix != ".rrd"} - FILES
    if strange:
        raise EgolocError(f"{out}: --overwrite replaces run folders only, and this is none or holds other files")


def _check_place(out: Path) -> None:
    """Raise where no folder can be made, before a long replay rather than after it."""
    above = next(parent for parent in out.absolute().parents if parent.exists())
    if not above.is_dir():
        raise EgolocError(f"{out}: cannot be written: {above} is a file, expected a folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise EgolocError(f"{out}: cannot be written: no permission to write in {above}")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """JSON with NaN refused, replaced at once if the file exists."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def load_facts(folder: Path) -> Facts:
    """What scoring must know of a run besides its tables. Raises EgolocError unless these are whole."""
    if not folder.is_dir():
        raise EgolocError(f"{folder}: {EXPECTED}")
    path = folder / "manifest.json"
    manifest = checked(read_json(path), Manifest, path)
    if not checked(manifest.get("keep", {}), Keep, path).everything:
        raise EgolocError(
            f"{folder}: cannot be scored again, its tables were thinned (--states-hz, --decisions): replay the log"
        )
    return manifest["facts"]


def versions() -> dict[str, str]:
    """Versions of this program and of the libraries that results depend on."""
    found = {}
    for name in VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    if not path.is_file():  # a pipe would be waited for
        raise EgolocError(f"{path}: expected a file")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
