"""Sums over pieces of a drive: one row a minute of log time, scene text, drive mode and method.

What is true of an interval (evaluated, covered by an output, within the limits) is summed over the intervals of the
output grid, each under its own tags; what is true of an output (its errors) is summed under the tags at its stamp. A
row's floats are summed in time order, so that they do not depend on how the drive was cut into batches.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from replay.arrow import text_codes, text_column
from sensors.clock import NS_PER_S

if TYPE_CHECKING:
    import pyarrow

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

SEGMENT_NS = 60 * NS_PER_S
METHODS = ("gnss", "egovm", "fusion", "smoothed")
THRESHOLDS = {"lon": (0.1, 0.2, 0.3), "lat": (0.1, 0.2, 0.3), "yaw": (0.1, 0.3, 0.6)}
"""m, m, deg."""
AXES = tuple(THRESHOLDS)
BELOW = {axis: tuple(f"{axis}_below_{threshold:g}" for threshold in THRESHOLDS[axis]) for axis in AXES}
TEXTS = ("log", "scene", "mode", "method")
INTEGERS = (
    *("segment", "evaluated_ns", "covered_ns", "good_ns", "epochs"),
    *(name for axis in AXES for name in (f"{axis}_count", *BELOW[axis])),
)
FLOATS = (
    *("evaluated_m", "covered_m", "good_m"),
    *(f"{axis}_{what}" for axis in AXES for what in ("abs", "squared", "max")),
)
NUMBERS: Mapping[str, type] = dict.fromkeys(INTEGERS, np.int64) | dict.fromkeys(FLOATS, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """The table.

    columns, each (R,): codes of log, scene, mode and method into `texts`; segment, minutes since the first IMU sample;
    evaluated ns and m of the grid at which this method can be compared; ns and m of that covered by outputs, and by
    outputs within the limits; epochs: evaluated ones of the grid; per axis: outputs, their sum of |e|, of e^2, their
    largest |e| (m, deg), and how many lie below each threshold.
    """

    texts: Mapping[str, Sequence[str]]
    columns: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.columns["segment"])

    def chosen(self, rows: Any) -> Self:
        """Some rows (a mask or indices)."""
        return type(self)(self.texts, {name: column[rows] for name, column in self.columns.items()})

    def of_method(self, method: str) -> Mask:
        """(R,) the rows of a method."""
        return self._is("method", {method})

    def tagged(self, kind: str, tag: str) -> Mask:
        """(R,) the rows whose scene or mode holds a tag."""
        return self._is(kind, {text for text in self.texts[kind] if tag in tags(text)})

    def tags(self, kind: str) -> list[str]:
        """The scene tags or modes that occur, in alphabetical order."""
        used = np.unique(self.columns[kind])
        return sorted({tag for code in used for tag in tags(self.texts[kind][code])})

    def _is(self, kind: str, wanted: set[str]) -> Mask:
        result: Mask = np.array([text in wanted for text in self.texts[kind]], bool)[self.columns[kind]]
        return result

    def to_arrow(self) -> "pyarrow.Table":
        """The table, texts as dictionary strings."""
        import pyarrow as pa

        coded: dict[str, Any] = {name: text_column(self.columns[name], self.texts[name]) for name in TEXTS}
        return pa.table(coded | {name: pa.array(self.columns[name]) for name in NUMBERS})

    @classmethod
    def from_arrow(cls, table: "pyarrow.Table") -> Self:
        """The table again."""
        coded = {name: text_codes(table[name]) for name in TEXTS}
        columns: dict[str, NDArray[Any]] = {name: codes for name, (codes, _) in coded.items()}
        columns |= {name: table[name].to_numpy() for name in NUMBERS}
        return cls({name: texts for name, (_, texts) in coded.items()}, columns)


def tags(text: str) -> list[str]:
    """The tags in a scene text, ``canyon,night``; none in an empty one."""
    return list(dict.fromkeys(tag for part in text.split(",") if (tag := part.strip())))


def joined(parts: Sequence[tuple[str, Segments]]) -> Segments:
    """The tables of several logs one after the other, each under the name given with it."""
    texts: dict[str, dict[str, int]] = {name: {} for name in TEXTS}
    stacked: dict[str, list[NDArray[Any]]] = {name: [] for name in (*TEXTS, *NUMBERS)}
    for log, part in parts:
        for kind in TEXTS:
            own = [log] * len(part.texts[kind]) if kind == "log" else part.texts[kind]
            place = [texts[kind].setdefault(text, len(texts[kind])) for text in own]
            stacked[kind].append(np.array(place, np.int32)[part.columns[kind]])
        for name in NUMBERS:
            stacked[name].append(part.columns[name])
    columns = {name: np.concatenate([np.empty(0, NUMBERS.get(name, np.int32)), *c]) for name, c in stacked.items()}
    return Segments({name: tuple(known) for name, known in texts.items()}, columns)
