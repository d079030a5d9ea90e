"""What opening a map file costs a process that did nothing before: seconds, and MB of memory."""

import subprocess
import sys
import time
from pathlib import Path

from replay.bench.memory import resident_mb
from sensors.maps.map_file import open_map


def first_opening(path: Path) -> tuple[float, float]:
    """Seconds and MB of the first opening in a fresh process; its imports are not counted."""
    done = subprocess.run([sys.executable, "-m", __name__, str(path)], check=True, capture_output=True, text=True)
    seconds, grown_mb = map(float, done.stdout.split())
    return seconds, grown_mb


if __name__ == "__main__":
    _before, _start = resident_mb(), time.perf_counter()
    _file = open_map(sys.argv[1])
    print(time.perf_counter() - _start, resident_mb() - _before)
