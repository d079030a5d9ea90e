"""Reading the files of a run folder: what is missing, damaged or of another kind is named."""

import json
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict, TypeVar

import msgspec

from fusion.result import Cause, Health, Level, Reason, Sensor
from replay.health import LEVELS
from replay.references import Excluded
from sensors.bounds import PositiveInt
from sensors.errors import EgolocError

if TYPE_CHECKING:
    import pyarrow

T = TypeVar("T")

CODES: Mapping[str, type[IntEnum]] = {
    "sensor": Sensor,
    "reason": Reason,
    "excluded": Excluded,
    "health": Health,
    "health_cause": Cause,
    **dict.fromkeys(LEVELS, Level),
}
"""Columns that are numbers in memory and dictionary strings (lower-case names) in Parquet."""
TEXTS = ("scene", "mode")
"""Columns that are codes into lists of tags in memory and dictionary strings in Parquet."""
EXPECTED = "expected a run folder, as egoloc replay writes it"


class ReferenceFacts(TypedDict):
    """What a run was scored against; None: nothing."""

    kind: str | None
    source: str | None
    heading: str | None


class Facts(TypedDict):
    """What scoring needs besides the tables, kept in manifest.json."""

    order: str
    period_ns: PositiveInt
    start_ns: int
    alignment_s: float | None
    reference: ReferenceFacts
    hide_gnss: dict[str, float] | None
    stretches: list[tuple[int, int]] | None
    health: dict[str, int]
    warnings: list[dict[str, str]]
    left_out: list[dict[str, str | int]]
    smoothed: NotRequired[bool]
    estimates: NotRequired[list[dict[str, Any]]]


class Manifest(TypedDict):
    """The part of manifest.json that other commands rely on."""

    facts: Facts
    keep: NotRequired[dict[str, Any]]


class SeenAxis(TypedDict, total=False):
    """Errors along an axis."""

    rmse: float | None


class SeenMethod(TypedDict, total=False):
    """A method's scores."""

    ar: float | None
    lon: SeenAxis | None
    lat: SeenAxis | None
    yaw: SeenAxis | None


class SeenHidden(TypedDict):
    """How the hidden stretches ended."""

    stretches: int
    length_s: float
    end_horizontal_m: dict[str, float | None]


class SeenMetrics(TypedDict, total=False):
    """The part of metrics.json that the viewer relies on."""

    limits: dict[str, float]
    methods: dict[str, SeenMethod]
    hidden: SeenHidden
    distance_m: float
    warnings: list[dict[str, str]]


class SeenManifest(TypedDict, total=False):
    """The part of manifest.json that the viewer relies on."""

    log: dict[str, Any]


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object."""
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise EgolocError(f"{path}: missing: {EXPECTED}") from None
    except ValueError as error:
        raise EgolocError(f"{path}: expected JSON: {error}") from None
    if not isinstance(content, dict):
        raise EgolocError(f"{path}: expected an object, got {type(content).__name__}")
    return content


def checked(content: dict[str, Any], kind: type[T], path: Path) -> T:
    """The part of a JSON object that a TypedDict describes."""
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        what, _, place = str(error).partition(" - at ")
        key = place.strip("`").removeprefix("$").removeprefix(".")
        raise EgolocError(f"{path}: {key + ': ' if key else ''}{what[0].lower()}{what[1:]}") from None


def read_table(path: Path, columns: Sequence[str]) -> "pyarrow.Table":
    """The columns of a table, with checksums verified: numbers, the known names of CODES and the texts of TEXTS."""
    import pyarrow as pa

    groups = list(read_groups(path, columns))
    return pa.concat_tables([table.unify_dictionaries() for table in groups])


def read_groups(path: Path, columns: Sequence[str]) -> Iterator["pyarrow.Table"]:
    """What ``read_table`` reads, by row groups; one empty table where there are none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise EgolocError(f"{path}: missing: {EXPECTED}")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            missing = [name for name in columns if name not in file.schema_arrow.names]
            if missing:
                raise EgolocError(f"{path}: expected the columns of a run, without: {', '.join(missing)}")
            for group in range(file.num_row_groups):
                yield _checked_table(file.read_row_group(group, columns=list(columns)), path)
            if not file.num_row_groups:
                yield _checked_table(file.read(columns=list(columns)), path)
    except (pa.ArrowException, OSError) as error:
        raise EgolocError(f"{path}: expected a Parquet file: {str(error).splitlines()[0]}") from None


def _checked_table(table: "pyarrow.Table", path: Path) -> "pyarrow.Table":
    for name in table.column_names:
        problem = _problem(name, table[name])
        if problem:
            raise EgolocError(f"{path}: column {name}: {problem}")
    return table


def _problem(name: str, column: "pyarrow.ChunkedArray") -> str:
    """Why a column cannot be used."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = column.type
    if name not in CODES and name not in TEXTS:
        number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
        if not number:
            return f"expected numbers, got {kind}"
        return "expected stamps, got nulls" if name == "t_ns" and column.null_count else ""
    if not pa.types.is_string(kind.value_type if pa.types.is_dictionary(kind) else kind):
        return f"expected names, got {kind}"
    if name in TEXTS:
        return "expected names, got nulls" if column.null_count else ""
    known = {member.name.lower() for member in CODES[name]}
    strange = [value for value in pc.unique(column.cast(pa.string())).to_pylist() if value not in known]
    return f"unknown name {strange[0]!r}" if strange else ""
