"""Files that are written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sensors.errors import EgolocError


@contextmanager
def whole_file(target: Path, *also: type[Exception]) -> Iterator[Path]:
    """A temporary name beside target that becomes it when the block ends well; else nothing is left of it.

    Raises EgolocError for an OSError of the block, and for what else a writer's library raises where it cannot write
    (also).
    """
    unwritten: tuple[type[Exception], ...] = (OSError, *also)
    partial = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        yield partial
        partial.replace(target)
    except unwritten as error:
        reason = getattr(error, "strerror", None) or (str(error).splitlines() or [type(error).__name__])[0]
        raise EgolocError(f"{target}: cannot be written: {reason}") from None
    finally:
        with suppress(OSError):  # where nothing could be written there is nothing to clear away
            partial.unlink(missing_ok=True)
