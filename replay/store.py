"""The run folder: written whole to a temporary name and then renamed; read back for scoring."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from replay.run_files import CODES, EXPECTED, Facts, Manifest, checked, read_json, read_table
from sensors.errors import EgolocError

if TYPE_CHECKING:
    import pyarrow

Columns = dict[str, NDArray[Any]]

FILES = {"config.toml", "manifest.json", "metrics.json", "states.parquet", "decisions.parquet", "report.html"}
STATES = (
    *("t_ns", "x", "y", "ref_x", "ref_y", "ref_speed", "ref_sigma_m", "ref_sigma_yaw", "excluded"),
    *("err_lon", "err_lat", "err_yaw", "sigma_lon", "sigma_lat", "stretch"),
)
DECISIONS = ("t_ns", "sensor", "row", "reason", "accepted", "status", "err_lon", "err_lat", "err_yaw")
"""The columns of both tables that scoring reads."""
VERSIONED = ("egoloc", "numpy", "numba", "scipy", "pyarrow", "pymap3d", "pyproj", "mcap")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A replay before scoring: the columns of both tables, and facts that scoring needs (kept in manifest.json)."""

    states: Columns
    decisions: Columns
    facts: Facts


@contextmanager
def new_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that becomes `out` when the block ends well and vanishes when it does not.

    Only a run folder is ever overwritten.
    """
    check_free(out, overwrite=overwrite)
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        if out.exists():
            old = out.with_name(f".{out.name}.{os.getpid()}.old")
            out.rename(old)
            temporary.rename(out)
            shutil.rmtree(old)
        else:
            temporary.rename(out)
    except OSError as error:
        raise EgolocError(f"{out}: cannot be written: {_reason(error)}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


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


def write_tables(folder: Path, run: Run) -> None:
    """states.parquet and decisions.parquet, side by side."""
    with ThreadPoolExecutor(2) as pool:
        tasks = [
            pool.submit(_write_parquet, folder / f"{name}.parquet", columns)
            for name, columns in (("states", run.states), ("decisions", run.decisions))
        ]
        for task in tasks:
            task.result()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """JSON with NaN refused, replaced at once if the file exists."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def load_run(folder: Path) -> Run:
    """The run in a folder, with the columns that scoring needs."""
    if not folder.is_dir():
        raise EgolocError(f"{folder}: {EXPECTED}")
    path = folder / "manifest.json"
    facts = checked(read_json(path), Manifest, path)["facts"]
    states, decisions = (
        _arrays(read_table(folder / f"{name}.parquet", columns))
        for name, columns in (("states", STATES), ("decisions", DECISIONS))
    )
    return Run(states, decisions, facts)


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


def _write_parquet(path: Path, columns: Columns) -> None:
    import pyarrow.parquet as pq

    table = _arrow_table(columns)
    names = [name for name in columns if name in CODES]
    options = {"compression": "lz4", "write_statistics": False, "write_page_checksum": True}
    pq.write_table(table, path, use_dictionary=names, **options)


def _arrow_table(columns: Columns) -> "pyarrow.Table":
    import pyarrow as pa

    arrays = {}
    for name, column in columns.items():
        if name in CODES:
            names = pa.array([member.name.lower() for member in CODES[name]])
            arrays[name] = pa.DictionaryArray.from_arrays(pa.array(column.astype(np.int8)), names)
        elif column.ndim == 2:
            flat = pa.array(np.ascontiguousarray(column).ravel())
            arrays[name] = pa.FixedSizeListArray.from_arrays(flat, column.shape[1])
        else:
            arrays[name] = pa.array(np.ascontiguousarray(column))
    return pa.table(arrays)


def _arrays(table: "pyarrow.Table") -> Columns:
    """Every column as an array; dictionary strings as codes again."""
    return {name: _codes(name, table[name]) if name in CODES else table[name].to_numpy() for name in table.column_names}


def _codes(name: str, column: Any) -> NDArray[np.int8]:
    import pyarrow as pa

    codes = {member.name.lower(): member.value for member in CODES[name]}
    whole = column.cast(pa.string()).dictionary_encode().combine_chunks()
    whole = pa.concat_arrays(whole.chunks) if isinstance(whole, pa.ChunkedArray) else whole
    numbers = np.array([codes[text] for text in whole.dictionary.to_pylist()], np.int8)
    return numbers[whole.indices.to_numpy(zero_copy_only=False)] if len(whole) else np.empty(0, np.int8)
