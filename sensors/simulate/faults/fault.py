"""What a fault is, and what may happen to any sensor's rows: lost, stuck, late, repeated, stamped wrongly."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Mask = NDArray[np.bool_]
Three = tuple[float, float, float]

SEVERITIES = ("mild", "medium", "severe")
SQUEEZED = 100
"""A burst comes so many times faster than it was measured."""
APART_NS = 1_000_000
"""Repeated measurements with stamps of their own follow each other so closely."""


class Rows(NamedTuple):
    """Rows of one record before it is known whether a record can hold them.

    true_ns: (N,) stamps before any fault; columns: those of the record, each (N, ...).
    """

    true_ns: Nanoseconds
    columns: Mapping[str, NDArray[Any]]

    def chosen(self, rows: Any) -> "Rows":
        """Some of the rows (a mask or indices)."""
        return Rows(self.true_ns[rows], {name: column[rows] for name, column in self.columns.items()})

    def having(self, **columns: NDArray[Any]) -> "Rows":
        """The rows with other columns in place of theirs."""
        return Rows(self.true_ns, {**self.columns, **columns})


class During(NamedTuple):
    """Where rows lie in the time of a fault, and how bad it is.

    since_s: (N,) s since its begin; number: (N,) of the record's rows since then; size: magnitude; first: the first
    row of the record (one); azimuth: a direction drawn for the fault, rad; rng: draws row by row.
    """

    since_s: Floats
    number: NDArray[np.int64]
    size: float
    first: Rows
    azimuth: float
    rng: np.random.Generator


Act = Callable[[Rows, During], Rows]
"""What happens to the rows of one record within the time of a fault."""


@dataclass(frozen=True)
class Fault:
    """A way in which sensors fail.

    doc: one line with {} for the magnitude; acts: by record of a Log; sizes, lengths_s: by severity, a size of None
    says that the length is the magnitude; back: it moves stamps back by its size, s.
    """

    name: str
    doc: str
    acts: Mapping[str, Act]
    sizes: Three | None
    lengths_s: Three = (20.0, 20.0, 20.0)
    unit: str = ""
    back: bool = False
    words: tuple[str, str, str] | None = field(default=None)
    """In place of sizes that are no numbers."""

    def size(self, severity: str) -> float:
        """The magnitude; 0 where it is the length."""
        return self.sizes[SEVERITIES.index(severity)] if self.sizes is not None else 0.0

    def length_s(self, severity: str) -> float:
        """The usual length, s."""
        return self.lengths_s[SEVERITIES.index(severity)]

    def magnitude(self, severity: str, length_s: float) -> str:
        """The magnitude with its unit."""
        if self.words is not None:
            return self.words[SEVERITIES.index(severity)]
        size, unit = (length_s, "s") if self.sizes is None else (self.size(severity), self.unit)
        return f"{size:g} {unit}".rstrip()

    def told(self, severity: str, length_s: float) -> str:
        """The line with the magnitude."""
        return self.doc.format(self.magnitude(severity, length_s))


def lost(rows: Rows, during: During) -> Rows:
    """Nothing comes."""
    return rows.chosen(np.zeros(len(rows.true_ns), bool))


def thinned(rows: Rows, during: During) -> Rows:
    """One of so many comes."""
    return rows.chosen(during.number % round(during.size) == 0)


def stuck(*names: str) -> Act:
    """Columns keep the values of the first row."""

    def act(rows: Rows, during: During) -> Rows:
        count = len(rows.true_ns)
        return rows.having(**{name: np.repeat(during.first.columns[name], count, axis=0) for name in names})

    return act


def late(rows: Rows, during: During) -> Rows:
    """Stamps are right, arrivals late by the size, s."""
    return rows.having(arrival_ns=rows.columns["arrival_ns"] + round(during.size * NS_PER_S))


def overtaken(rows: Rows, during: During) -> Rows:
    """Every second message is late by the size, s, so that the next ones overtake it."""
    delay = np.where(during.number % 2 == 0, round(during.size * NS_PER_S), 0)
    return rows.having(arrival_ns=rows.columns["arrival_ns"] + delay)


def burst(rows: Rows, during: During) -> Rows:
    """Nothing arrives for the size, s, then all of it at once, time after time; stamps are right."""
    return rows.having(arrival_ns=rows.true_ns + _until_burst(during))


def restamped(rows: Rows, during: During) -> Rows:
    """As burst, and stamped when it arrives."""
    t_ns = rows.true_ns + _until_burst(during)
    return rows.having(t_ns=t_ns, arrival_ns=t_ns)


def _until_burst(during: During) -> Nanoseconds:
    """(N,) ns from the measurements to their arrival in a burst, in their order."""
    since = np.rint(during.since_s * NS_PER_S).astype(np.int64)
    period = round(during.size * NS_PER_S)
    into = since % period
    result: Nanoseconds = period - into + into // SQUEEZED
    return result


def ahead(rows: Rows, during: During) -> Rows:
    """Stamps run ahead by the size, s."""
    return rows.having(t_ns=rows.columns["t_ns"] + round(during.size * NS_PER_S))


def behind(rows: Rows, during: During) -> Rows:
    """Stamps stay behind by the size, s."""
    return rows.having(t_ns=rows.columns["t_ns"] - round(during.size * NS_PER_S))


def duplicated(rows: Rows, during: During) -> Rows:
    """Every message comes so many times."""
    return rows.chosen(np.repeat(np.arange(len(rows.true_ns)), round(during.size)))


def repeated(rows: Rows, during: During) -> Rows:
    """Every message comes so many more times, with stamps of its own."""
    times = round(during.size) + 1
    more = rows.chosen(np.repeat(np.arange(len(rows.true_ns)), times))
    after = np.tile(np.arange(times) * APART_NS, len(rows.true_ns))
    return more.having(t_ns=more.columns["t_ns"] + after, arrival_ns=more.columns["arrival_ns"] + after)


def every(during: During) -> Mask:
    """(N,) one of so many rows as the size says."""
    mask: Mask = during.number % round(during.size) == 0
    return mask


def spoilt(name: str, value: float) -> Act:
    """One of so many rows has a column of value throughout."""

    def act(rows: Rows, during: During) -> Rows:
        column = rows.columns[name].copy()
        column[every(during)] = value
        return rows.having(**{name: column})

    return act


def times(name: str) -> Act:
    """A column times the size."""

    def act(rows: Rows, during: During) -> Rows:
        return rows.having(**{name: rows.columns[name] * during.size})

    return act
