"""Loops over the bytes of point clouds (numba). Arrays in and out; nothing is read or written beyond their ends."""

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Bytes = NDArray[np.uint8]


@kernel(allocates=True, nogil=True)
def lzf_decompress(packed: Bytes, out: Bytes) -> int:
    """Expand LZF data into out; returns how many bytes it gave, -1 where it is damaged or gives more than out holds.

    A byte below 32 is followed by one more byte than it says, to be copied; any other names a stretch of what is out
    already: its high 3 bits the length less 2 (7: the next byte adds to it), its low 5 and the next byte the distance
    less 1. Source: Marc Lehmann's liblzf.
    """
    at, end = 0, 0
    while at < len(packed):
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(packed) or end + length > len(out):
                return -1
            for k in range(length):
                out[end + k] = packed[at + k]
            at += length
        else:
            length = control >> 5
            if length == 7:
                if at >= len(packed):
                    return -1
                length += int(packed[at])
                at += 1
            if at >= len(packed):
                return -1
            source = end - ((control & 31) << 8) - int(packed[at]) - 1
            at += 1
            length += 2
            if source < 0 or end + length > len(out):
                return -1
            for k in range(length):  # one by one: the stretch may reach into what it writes
                out[end + k] = out[source + k]
        end += length
    return end
