"""Groups of arrays put away in a temporary file, and read back in the order in which they came or the other way."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

Group = tuple[NDArray[Any], ...]


class Spool:
    """A file without a name in a folder (None: the system's for temporary files): it is gone when the program is."""

    def __init__(self, folder: Path | None = None) -> None:
        self._file = TemporaryFile(dir=folder)  # noqa: SIM115 - closed by close
        self._starts: list[tuple[int, int]] = []  # offset, and how many arrays

    def append(self, *arrays: NDArray[Any]) -> None:
        """Put a group away."""
        self._file.seek(0, 2)
        self._starts.append((self._file.tell(), len(arrays)))
        for array in arrays:
            np.save(self._file, array, allow_pickle=False)

    def __len__(self) -> int:
        return len(self._starts)

    def __iter__(self) -> Iterator[Group]:
        return self._read(self._starts)

    def __reversed__(self) -> Iterator[Group]:
        return self._read(reversed(self._starts))

    def _read(self, starts: Iterable[tuple[int, int]]) -> Iterator[Group]:
        for offset, count in starts:
            self._file.seek(offset)
            yield tuple(np.load(self._file, allow_pickle=False) for _ in range(count))

    @property
    def nbytes(self) -> int:
        """Size of the file."""
        return self._file.seek(0, 2)

    def close(self) -> None:
        """Delete it."""
        self._file.close()
