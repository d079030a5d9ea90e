"""Cameras of Argoverse 2 logs: made images beside a real log's calibration and sweeps, and mistakes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from sensors.datasets import frames
from sensors.errors import EgolocError
from sensors.mcap.frames import read_frames
from sensors.mcap.io import write_log
from sensors.records import Log

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
SWEEPS = (315966265259836000, 315966265360032000)
MS = 1_000_000


def write_image(folder: Path, camera: str, t_ns: int, size: tuple[int, int]) -> None:
    path = folder / "sensors/cameras" / camera / f"{t_ns}.jpg"
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.new("RGB", size, (t_ns // MS % 256, 100, 50)).save(path, quality=30)


@pytest.fixture
def made(data: Path, tmp_path: Path) -> Path:
    """The real log's sweeps and calibration, with images of two cameras every 50 ms, one 20 ms late."""
    folder = tmp_path / LOG
    for part in ("sensors", "calibration"):
        shutil.copytree(data / "av2" / LOG / part, folder / part, copy_function=shutil.copyfile)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    for k in range(-1, 4):
        write_image(folder, "ring_front_center", SWEEPS[0] + k * 50 * MS + 7, (1550, 2048))
    for k in range(2):
        write_image(folder, "ring_side_left", SWEEPS[0] + k * 100 * MS + 20 * MS, (2048, 1550))
    return folder


def test_images_beside_sweeps(made: Path, tmp_path: Path) -> None:
    found = list(frames("argoverse2", made))
    assert [frame.t_ns for frame in found] == list(SWEEPS)
    assert [[image.name for image in frame.images] for frame in found] == [["ring_front_center", "ring_side_left"]] * 2
    ahead, aside = found[0].images
    assert [frame.images[0].t_ns for frame in found] == [SWEEPS[0] + 7, SWEEPS[0] + 100 * MS + 7]
    assert aside.t_ns == SWEEPS[0] + 20 * MS
    assert (ahead.width, ahead.height, ahead.lens) == (1550, 2048, "none")
    assert ahead.K[0].tolist() == pytest.approx([1776.0414843455, 0.0, 777.9905731522801])
    np.testing.assert_allclose(ahead.T_body_camera[:3, 2], [1.0, 0.0, 0.0], atol=0.02)  # looks ahead
    np.testing.assert_allclose(ahead.T_body_camera[:3, 1], [0.0, 0.0, -1.0], atol=0.02)  # stands upright
    np.testing.assert_allclose(aside.T_body_camera[:3, 2], [-0.16, 0.99, 0.0], atol=0.05)  # to the left, a bit back
    assert ahead.rgb().shape == (2048, 1550, 3)
    write_log(tmp_path / "a.mcap", Log(), frames=found)
    back = list(read_frames(tmp_path / "a.mcap"))
    assert [[image.data for image in frame.images] for frame in back] == [
        [image.data for image in frame.images] for frame in found
    ]


def test_the_sweep_appears_in_the_cameras(made: Path) -> None:
    """The ground before the vehicle, some 0.3 m under its axle, is in the lower half of the front image."""
    frame = next(iter(frames("argoverse2", made)))
    body = np.concatenate([sweep.in_body() for sweep in frame.sweeps])
    seen = frame.images[0].seen(body)
    assert seen.inside.sum() > 3000
    ground = seen.inside & (body[:, 2] < 0.0) & (seen.depth < 15.0)
    assert ground.sum() > 500
    assert seen.pixels[ground, 1].min() > 1024.0


def test_mistakes(made: Path) -> None:
    cameras = made / "sensors/cameras"
    write_image(made, "ring_side_left", SWEEPS[1], (64, 48))
    with pytest.raises(EgolocError, match=f"{SWEEPS[1]}.jpg: expected 2048 x 1550 pixels, got 64 x 48"):
        list(frames("argoverse2", made))
    (cameras / f"ring_side_left/{SWEEPS[1]}.jpg").write_bytes(b"nothing")
    with pytest.raises(EgolocError, match="expected a JPEG or PNG"):
        list(frames("argoverse2", made))
    (cameras / f"ring_side_left/{SWEEPS[1]}.jpg").rename(cameras / "ring_side_left/first.jpg")
    with pytest.raises(EgolocError, match=r"first.jpg: expected an image's stamp in ns"):
        list(frames("argoverse2", made))
    (cameras / "ring_side_left").rename(cameras / "roof")
    (cameras / "roof/first.jpg").unlink()
    with pytest.raises(EgolocError, match=r"intrinsics.feather: sensor_name: expected one row roof, got 0"):
        list(frames("argoverse2", made))
