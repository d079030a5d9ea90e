"""A picture of a recording in the rerun viewer, drawn without a window: `python docs/picture.py RRD PNG [SECONDS]`.

Needs a Vulkan driver; Debian's mesa-vulkan-drivers has one in software. SECONDS is where the time cursor stands.
"""

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from PIL import Image
from rerun.experimental import ViewerClient

SIZE = (1600, 1040)
PATIENCE_S = 30.0
T = TypeVar("T")


def main() -> None:
    """Draw the recording and write the PNG."""
    rrd, png = Path(sys.argv[1]), Path(sys.argv[2])
    cursor = float(sys.argv[3]) if len(sys.argv) > 3 else 0.0
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--headless", "--window-size", f"{SIZE[0]}x{SIZE[1]}"]
    command += ["--bind", "127.0.0.1", "--port", str(port)]
    # without its log, the viewer's notices do not cover the picture
    viewer = subprocess.Popen(command, env={**os.environ, "RUST_LOG": "off"}, start_new_session=True)
    client = _patiently(lambda: _connected(port))
    try:
        client.open(str(rrd.resolve()))
        _patiently(lambda: _loaded(client))
        client.set_time("drive", duration=cursor, play_state="paused")
        time.sleep(2.0)
        for view in client.get_state().views:
            for report in view.reports:
                print(f"{view.name}: {report.severity}: {report.summary}", file=sys.stderr)
        with tempfile.TemporaryDirectory() as folder:
            raw = Path(folder) / "raw.png"
            client.save_screenshot(str(raw))
            _shrink(raw, png)
    finally:
        os.killpg(viewer.pid, 15)
        viewer.wait()


def _connected(port: int) -> ViewerClient:
    client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
    client.get_state()
    return client


def _loaded(client: ViewerClient) -> None:
    state = client.get_state()
    if state.loading or not any(recording.timelines for recording in state.recordings):
        raise RuntimeError(f"still loading: {state.loading}")


def _patiently(attempt: Callable[[], T]) -> T:
    """Try again until it works."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return attempt()
        except (RuntimeError, ConnectionError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def _shrink(raw: Path, png: Path) -> None:
    """Without the viewer's title bar, at one pixel a point, in 256 colours."""
    picture = Image.open(raw).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
    png.parent.mkdir(parents=True, exist_ok=True)
    picture.crop((0, 36, *SIZE)).quantize(256, method=Image.Quantize.MEDIANCUT).save(png, optimize=True)


if __name__ == "__main__":
    main()
