"""Coded columns to Parquet and back: texts as dictionary strings, everything else as numbers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from replay.run_files import EXPECTED
from sensors.errors import EgolocError

if TYPE_CHECKING:
    import pyarrow

Columns = Mapping[str, NDArray[Any]]


def text_column(codes: NDArray[Any], texts: Sequence[str]) -> "pyarrow.DictionaryArray":
    """Dictionary strings of codes (N,) into texts, the same for the same strings whatever their codes were."""
    import pyarrow as pa

    used = np.unique(codes)
    names = sorted({texts[code] for code in used})
    place = np.zeros(len(texts), np.int32)
    place[used] = [names.index(texts[code]) for code in used]
    return pa.DictionaryArray.from_arrays(pa.array(place[codes]), pa.array(names, pa.string()))


def text_codes(column: "pyarrow.ChunkedArray") -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """(N,) codes of dictionary strings, and the texts."""
    whole = column.unify_dictionaries().combine_chunks()
    if not len(whole):
        return np.empty(0, np.int32), ()
    codes: NDArray[np.int32] = whole.indices.to_numpy(zero_copy_only=False).astype(np.int32, copy=False)
    return codes, tuple(whole.dictionary.to_pylist())


def read_columns(path: Path, texts: Sequence[str], numbers: Mapping[str, type]) -> "pyarrow.Table":
    """A table of dictionary strings and of numbers without nulls; EgolocError names what is missing or damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise EgolocError(f"{path}: missing: {EXPECTED}")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True, read_dictionary=list(texts)) as file:
            held = file.schema_arrow.names
            missing = [name for name in (*texts, *numbers) if name not in held]
            if missing:
                raise EgolocError(f"{path}: expected the columns of a run, without: {', '.join(missing)}")
            table = file.read(columns=[*texts, *numbers], use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise EgolocError(f"{path}: expected a Parquet file: {str(error).splitlines()[0]}") from None
    for name, kind in (*((name, None) for name in texts), *numbers.items()):
        found = table[name].type
        fits = pa.types.is_dictionary(found) if kind is None else found == pa.from_numpy_dtype(kind)
        if not fits or table[name].null_count:
            raise EgolocError(f"{path}: column {name}: expected {_words(kind)} without nulls, got {found}")
    return table


def _words(kind: type | None) -> str:
    return "strings" if kind is None else np.dtype(kind).name
