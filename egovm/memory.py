"""Keeping memory that is freed, for a network that needs the same again at the next frame.

The C library on Linux gives blocks of many MB back to the system, which fills as many pages with zeros when they are
asked for again: a third of a frame's time for maps of 640 x 640 cells, 15,000 pages of them.
"""

import ctypes
import sys

_TRIM, _LARGE = -1, -3
"""glibc's M_TRIM_THRESHOLD and M_MMAP_THRESHOLD (malloc.h)."""
_KEPT = 1 << 30
"""Bytes that the process may keep beyond what it uses, and below which a block is kept."""


def keep_freed_memory() -> bool:
    """Tell the C library to keep up to a GB of what is freed; whether it does. Only glibc has a way to."""
    if sys.platform != "linux":
        return False
    change = getattr(ctypes.CDLL(None), "mallopt", None)
    return change is not None and bool(change(_TRIM, _KEPT)) and bool(change(_LARGE, _KEPT))
