"""``@kernel()``: how every loop of the project is compiled (numba), and where the machine code is kept.

numba's cache watches only the file that holds a function: one that inlined a function of another file would run as it
was before an update. So the cache's folder is named by a hash of the sources.
"""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

_PACKAGES = ("sensors", "egovm", "fusion", "replay")
_IMPORTED = re.compile(rf"^from ((?:{'|'.join(_PACKAGES)})\S*) import", re.MULTILINE)
_KEPT_S = 7 * 86_400
"""Machine code of other versions of the sources is deleted when it is older than this, s."""


def kernel(*, allocates: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of a function on numbers and arrays. options: numba's (inline, nogil, fastmath).

    allocates: the function makes arrays. Without it numba counts no references to arrays (a private option of numba's):
    counting is atomic and took most of the filter's time, 0.7 us a call with thirty arrays. Nor does anything call a
    kernel through a C pointer, so numba need not compile a way in for that.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(cache_folder())
        try:
            return numba.njit(cache=True, _nrt=allocates, no_cfunc_wrapper=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


@cache
def cache_folder() -> Path:
    """Where machine code of just these sources is kept: in $NUMBA_CACHE_DIR, else in the user's cache folder."""
    root = Path(os.environ.get("NUMBA_CACHE_DIR") or _user_cache())
    folder = root / source_hash()
    if not folder.exists():
        _forget_old(root)
    return folder


def source_hash(top: Path | None = None) -> str:
    """Hash of the files with kernels and of the project's files that they import functions and constants from."""
    top = top or Path(__file__).resolve().parent.parent
    python = [path for package in _PACKAGES for path in (top / package).rglob("*.py")]
    texts = {path: path.read_text() for path in python}
    used = {path for path, text in texts.items() if "\n@kernel(" in text}
    for path in list(used):
        for module in _IMPORTED.findall(texts[path]):
            used.add(top / (module.replace(".", "/") + ".py"))
    digest = hashlib.sha256()
    for path in sorted(used & texts.keys()):
        digest.update(path.relative_to(top).as_posix().encode() + b"\0" + texts[path].encode())
    return digest.hexdigest()[:16]


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "egoloc" / "kernels"


def _forget_old(root: Path) -> None:
    if root.is_dir():
        for folder in root.iterdir():
            if len(folder.name) == 16 and time.time() - folder.stat().st_mtime > _KEPT_S:
                shutil.rmtree(folder, ignore_errors=True)
