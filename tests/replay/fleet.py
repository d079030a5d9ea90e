"""What the tests of campaigns share: a scenario of half a minute, and the bytes of run folders."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

SCENARIO = """
name = "tiny"
doc = "Half a minute of city: long enough to align and to be scored."
seed = 0
duration_s = 30.0
"""
CAMPAIGN_FILES = ["config.toml", "manifest.json", "metrics.json", "percentiles.parquet", "segments.parquet"]
LOG_FILES = sorted([*CAMPAIGN_FILES, "states.parquet", "decisions.parquet"])
PATIENCE_S = 300.0


def tiny(folder: Path, drives: int) -> str:
    """A LOG argument: so many drives, of a scenario that is written into the folder."""
    path = folder / "tiny.toml"
    path.write_text(SCENARIO)
    return f"scenario:{path},drives={drives}"


def content(run: Path, *, command: bool = False) -> dict[str, bytes]:
    """Every file of a run folder or campaign by its path in it; of the manifests without the command unless told."""
    found = {str(path.relative_to(run)): path.read_bytes() for path in sorted(run.rglob("*")) if path.is_file()}
    for name in [name for name in found if name.endswith("manifest.json") and not command]:
        manifest = json.loads(found[name])
        del manifest["command"]
        found[name] = json.dumps(manifest).encode()
    return found


def start(*arguments: object, cwd: Path) -> "subprocess.Popen[str]":
    """egoloc in a process group of its own."""
    command = [sys.executable, "-m", "replay.cli", *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=cwd, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for something that happens sooner or later."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def workers(process: int) -> list[int]:
    """The workers that a process has spawned and that are alive."""
    return [child for child in _children(process) if alive(child) and "spawn_main" in _command(child)]


def alive(process: int) -> bool:
    """Whether a process runs; a zombie does not."""
    return _read(Path(f"/proc/{process}/stat")).rpartition(")")[2].split()[:1] not in ([], ["Z"])


def _children(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task").glob("*/children")
    return [int(pid) for path in found for pid in _read(path).split()]


def _command(process: int) -> str:
    return _read(Path(f"/proc/{process}/cmdline"))


def _read(path: Path) -> str:
    """A file of /proc; nothing once its process or thread is gone."""
    try:
        return path.read_text()
    except OSError:
        return ""


def kill(process: int) -> None:
    """kill -9."""
    os.kill(process, signal.SIGKILL)
