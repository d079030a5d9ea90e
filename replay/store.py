"""The run folder: written whole to a temporary name and then renamed; read back for scoring."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Reason, Sensor
from replay.references import Excluded
from sensors.errors import EgolocError

if TYPE_CHECKING:
    import pyarrow

Columns = dict[str, NDArray[Any]]
Facts = dict[str, Any]

CODES = {"sensor": Sensor, "reason": Reason, "excluded": Excluded}
"""Columns that are numbers here and dictionary strings (lower-case names) in Parquet."""
FILES = {"config.toml", "manifest.json", "metrics.json", "states.parquet", "decisions.parquet", "report.html"}
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
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
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


def check_free(out: Path, *, overwrite: bool = False) -> None:
    """Raise EgolocError unless a run folder can be written at `out`."""
    if not out.exists() and not out.is_symlink():
        return
    if not overwrite:
        raise EgolocError(f"{out}: exists already: choose another --out or add --overwrite")
    strange = not out.is_dir() or {p.name for p in out.iterdir() if p.suffix != ".rrd"} - FILES
    if strange:
        raise EgolocError(f"{out}: --overwrite replaces run folders only, and this is none or holds other files")


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
    temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    temporary.replace(path)


def load_run(folder: Path) -> tuple[Run, dict[str, Any]]:
    """The run in a folder, and its whole manifest."""
    if not folder.is_dir():
        raise EgolocError(f"{folder}: expected a run folder, as egoloc replay writes it")
    manifest = read_json(folder / "manifest.json")
    if not isinstance(manifest.get("facts"), dict):
        raise EgolocError(f"{folder / 'manifest.json'}: facts: expected an object")
    states, decisions = (_read_parquet(folder / f"{name}.parquet") for name in ("states", "decisions"))
    return Run(states, decisions, manifest["facts"]), manifest


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object."""
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise EgolocError(f"{path}: missing: expected a run folder, as egoloc replay writes it") from None
    except ValueError as error:
        raise EgolocError(f"{path}: expected JSON: {error}") from None
    if not isinstance(content, dict):
        raise EgolocError(f"{path}: expected an object, got {type(content).__name__}")
    return content


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
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_parquet(path: Path, columns: Columns) -> None:
    import pyarrow.parquet as pq

    table = _arrow_table(columns)
    names = [name for name in columns if name in CODES]
    pq.write_table(table, path, compression="lz4", use_dictionary=names, write_statistics=False)


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


def _read_parquet(path: Path) -> Columns:
    """Every column as an array; dictionary strings as codes again."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise EgolocError(f"{path}: missing: expected a run folder, as egoloc replay writes it")
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise EgolocError(f"{path}: expected a Parquet file: {str(error).splitlines()[0]}") from None
    return {name: _column(name, table[name]) for name in table.column_names if not pa.types.is_list(table[name].type)}


def _column(name: str, column: Any) -> NDArray[Any]:
    import pyarrow as pa

    if name in CODES:
        codes = {member.name.lower(): member.value for member in CODES[name]}
        whole = column.cast(pa.string()).dictionary_encode().combine_chunks()
        whole = pa.concat_arrays(whole.chunks) if isinstance(whole, pa.ChunkedArray) else whole
        numbers = np.array([codes[text] for text in whole.dictionary.to_pylist()], np.int8)
        return numbers[whole.indices.to_numpy(zero_copy_only=False)] if len(whole) else np.empty(0, np.int8)
    if pa.types.is_fixed_size_list(column.type):
        flat = column.combine_chunks()
        flat = flat if not isinstance(flat, pa.ChunkedArray) else pa.concat_arrays(flat.chunks)
        values: NDArray[Any] = flat.flatten().to_numpy(zero_copy_only=False)
        return values.reshape(-1, column.type.list_size)
    result: NDArray[Any] = column.to_numpy()
    return result
