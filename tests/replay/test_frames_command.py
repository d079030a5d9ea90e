"""egoloc frames, convert and info of logs with images, on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from PIL import Image as Pillow

from replay.chosen_frames import chosen_frames
from replay.cli import main
from replay.frame_picture import around, on_image
from sensors.frames import Frame, Sweep
from sensors.mcap.io import write_log
from sensors.motion import AlongTrajectory, Standing
from sensors.records import Log
from tests.sensors.mcap.clouds import frames
from tests.sensors.mcap.messages import START_NS
from tests.sensors.pictures import AHEAD, image


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error of a command."""
    code = main([str(word) for word in words])
    printed = capsys.readouterr()
    return code, " ".join(printed.out.split()), printed.err


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Three frames, the second of which has no image; two cameras that look ahead and back."""
    back = AHEAD @ np.diag([-1.0, 1.0, -1.0, 1.0])
    path = tmp_path / "a.mcap"
    sent = []
    for number, frame in enumerate(frames(3)):
        seen = Sweep(np.array([[11.5, 0.1, 1.2], [11.5, 9.0, 1.2], [-8.5, 0.0, 1.2]], np.float32))
        images = (
            image(frame.t_ns, "ahead", T_body_camera=AHEAD),
            image(frame.t_ns, "back", "mono8", T_body_camera=back),
        )
        sent.append(Frame(frame.t_ns, frame.arrival_ns, (seen,), images if number != 1 else ()))
    write_log(path, Log(), frames=sent)
    return path


def test_the_real_frame_becomes_a_picture_and_a_recording(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, png, rrd = tmp_path / "nu.mcap", tmp_path / "nu.png", tmp_path / "nu.rrd"
    code, out, _ = run(capsys, "convert", "nuscenes-frame", data / "nuscenes_frame", log)
    assert code == 0
    assert "points in each: 34688. Cameras: 1 frames, images: 1 of CAM_FRONT, 1 of CAM_FRONT_RIGHT" in out
    code, out, _ = run(capsys, "info", log)
    assert (
        "Camera CAM_BACK (/camera/CAM_BACK/image/compressed): 1 images, 1600 x 900 jpeg, no distortion; at (0.028"
        in out
    )
    code, out, _ = run(capsys, "frames", log, "--png", png, "--rrd", rrd)
    assert (code, out) == (0, f"Picture: {png} Recording: {rrd}")
    with Pillow.open(png) as drawn:
        assert drawn.width > 1800
        red, green, blue = np.asarray(drawn.convert("RGB"), int).reshape(-1, 3).T
    assert ((red > 200) & (green < 100) & (blue < 60)).sum() > 300  # points nearby
    entities = {chunk.entity_path for chunk in rr.chunk.RrdReader(str(rrd)).stream().to_chunks()}
    assert {"/body/lidar/0", "/body/cameras/CAM_FRONT", "/body/cameras/CAM_FRONT/image"} <= entities
    (chosen,) = chosen_frames(log, {}, 0.0, 1)
    assert isinstance(chosen.motion, AlongTrajectory)
    assert [[i.name for i in row] for row in around(chosen.frame.images)] == [
        ["CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT"],
        ["CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT"],
    ]


def test_points_are_drawn_on_the_images_that_show_them(made: Path) -> None:
    (chosen,) = chosen_frames(made, {}, 0.0, 1)
    assert isinstance(chosen.motion, Standing)
    ahead, back = (on_image(chosen, image) for image in chosen.frame.images)
    np.testing.assert_allclose(ahead.pixels, [[31.5 - 50.0 * 0.01, 23.5]], atol=1e-6)
    np.testing.assert_allclose(ahead.depth, [10.0], atol=1e-6)
    np.testing.assert_allclose(back.depth, [10.0], atol=1e-6)


def test_frames_are_chosen_by_time(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [c.frame.t_ns - START_NS for c in chosen_frames(made, {}, 0.0, 5)] == [0, 200_000_000]
    (late,) = chosen_frames(made, {}, 0.05, 5)
    assert (late.frame.t_ns - START_NS, late.at_s) == (200_000_000, 0.2)
    rrd = tmp_path / "a.rrd"
    assert run(capsys, "frames", made, "--rrd", rrd, "--count", 2)[0] == 0
    rows = {
        c.entity_path: c.num_rows for c in rr.chunk.RrdReader(str(rrd)).stream().to_chunks() if "image" in c.entity_path
    }
    assert set(rows) == {"/body/cameras/ahead/image", "/body/cameras/back/image"}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "expected --png FILE, --rrd FILE or both"),
        (("--png", "a.png", "--at", "9"), "a.mcap: expected a frame with images from 9 s on, got none"),
        (("--png", "a.png", "--at", "-1"), "expected --at of 0 or more"),
        (("--rrd", "a.rrd", "--count", "0"), "--count of 1 or more"),
    ],
)
def test_mistakes(
    made: Path, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(made.parent)
    code, _, error = run(capsys, "frames", made, *words)
    assert code == 2
    assert told in error
    assert error.count("\n") == 1
    assert [path.name for path in made.parent.iterdir()] == ["a.mcap"]


def test_logs_without_frames_and_pictures_that_cannot_be_written(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(tmp_path / "none.mcap", Log())
    code, _, error = run(capsys, "frames", tmp_path / "none.mcap", "--png", tmp_path / "a.png")
    assert (code, "expected a log with frames, got none" in error) == (2, True)
    code, _, error = run(capsys, "frames", made, "--png", tmp_path / "absent/a.png")
    assert (code, "cannot be written" in error) == (2, True)
    code, _, error = run(capsys, "frames", made, "--rrd", tmp_path / "absent/a.rrd")
    assert (code, "cannot be written" in error) == (2, True)


def test_info_lists_cameras_for_programs(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["info", str(made), "--json"])
    found = json.loads(capsys.readouterr().out)["cameras"]
    assert [(c["camera"], c["count"], c["width"], c["height"], c["format"]) for c in found] == [
        ("ahead", 2, 64, 48, "jpeg"),
        ("back", 2, 64, 48, "mono8"),
    ]
