"""Machine code is kept per version of the sources that went into it."""

from pathlib import Path

import numba
import numpy as np
import pytest

from sensors.kernel import cache_folder, kernel, source_hash


@kernel()
def twice(x: float) -> float:
    return 2.0 * x


def test_a_kernel_computes_and_leaves_numbas_setting_as_it_was() -> None:
    before = numba.config.CACHE_DIR
    assert twice(1.5) == 3.0
    assert before == numba.config.CACHE_DIR


def test_a_kernel_that_allocates_must_say_so() -> None:
    def zeros(n: int) -> np.ndarray:
        return np.zeros(n)

    def silent_zeros(n: int) -> np.ndarray:
        return np.zeros(n)

    assert kernel(allocates=True)(zeros)(3).shape == (3,)
    with pytest.raises(numba.core.errors.TypingError):
        kernel()(silent_zeros)(3)


def test_the_cache_is_named_by_the_sources() -> None:
    assert cache_folder().name == source_hash()


def test_the_hash_follows_kernels_and_what_they_import_only(tmp_path: Path) -> None:
    (tmp_path / "fusion").mkdir()
    loop, used, other = (tmp_path / "fusion" / name for name in ("loop.py", "used.py", "other.py"))
    loop.write_text("from fusion.used import RATE\n\n@kernel()\ndef f(x):\n    return x * RATE\n")
    used.write_text("RATE = 1.0\n")
    other.write_text("NAME = 'a'\n")
    first = source_hash(tmp_path)
    other.write_text("NAME = 'b'\n")
    assert source_hash(tmp_path) == first
    used.write_text("RATE = 2.0\n")
    second = source_hash(tmp_path)
    assert second != first
    loop.write_text(loop.read_text().replace("*", "+"))
    assert source_hash(tmp_path) not in (first, second)
