"""Scene tags and drive modes of a drive that comes in pieces: which holds at a time, as codes into a list of texts."""

import numpy as np
from numpy.typing import NDArray

from sensors.records import Tags

Nanoseconds = NDArray[np.int64]


class TagTrack:
    """texts: those seen so far, in order of appearance; the first, "", says nothing. The list only grows."""

    def __init__(self) -> None:
        self.texts = [""]
        self._since = np.array([np.iinfo(np.int64).min])
        self._codes = np.zeros(1, np.int16)

    def add(self, tags: Tags | None) -> None:
        """Take the tags of the next piece."""
        if tags is None:
            return
        for text in tags.text.tolist():
            if text not in self.texts:
                self.texts.append(text)
        codes = np.array([self.texts.index(text) for text in tags.text.tolist()], np.int16)
        self._since = np.concatenate((self._since, tags.t_ns))
        self._codes = np.concatenate((self._codes, codes))

    def at(self, t_ns: Nanoseconds) -> NDArray[np.int16]:
        """(N,) code of what holds at each time (N,)."""
        if len(self._codes) == 1:
            return np.full(len(t_ns), self._codes[0])
        return self._codes[np.maximum(np.searchsorted(self._since, t_ns, side="right") - 1, 0)]

    def forget(self, t_ns: int) -> None:
        """Only times after t_ns will be asked."""
        first = max(int(np.searchsorted(self._since, t_ns, side="right")) - 1, 0)
        self._since, self._codes = self._since[first:], self._codes[first:]
