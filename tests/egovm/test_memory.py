"""Freed memory that is kept is not asked of the system again."""

import subprocess
import sys

import pytest

_SCRIPT = """
import resource, sys
import numpy as np
from egovm.memory import keep_freed_memory

def faults(times):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(times):
        np.ones(40_000_000, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = faults(4)
told = keep_freed_memory()
faults(1)
print(first, int(told), faults(4))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of the C library on Linux")
def test_the_same_pages_are_used_again() -> None:
    done = subprocess.run([sys.executable, "-c", _SCRIPT], check=True, capture_output=True, text=True)
    first, told, after = map(int, done.stdout.split())
    assert not told or after < 0.1 * first
