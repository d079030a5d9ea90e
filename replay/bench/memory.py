"""How much memory a process has held."""

import resource
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")


def peak_mb() -> float:
    """Largest resident size of this process so far, MB.

    On Linux by what the kernel says of the program itself: ``ru_maxrss`` counts the parent's memory, too, since it is
    taken over when a process is started.
    """
    peak = _told("VmHWM:")
    if peak is not None:
        return peak
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 * 1024 if sys.platform == "darwin" else 1024)


def resident_mb() -> float:
    """Resident size of this process now, MB; NaN where the system does not tell it."""
    now = _told("VmRSS:")
    return float("nan") if now is None else now


def _told(name: str) -> float | None:
    """What Linux says of this process, MB."""
    if _STATUS.exists():
        for line in _STATUS.read_text().splitlines():
            if line.startswith(name):
                return int(line.split()[1]) / 1024
    return None
