"""Images in logs: what we write comes back, other tools read it, which frame an image belongs to, what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sensors.datasets.argoverse2_cameras import nearest
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.images import Image
from sensors.mcap.camera_summary import camera_topics
from sensors.mcap.frames import FrameReader, read_frames
from sensors.mcap.io import describe, read_log, write_log
from sensors.mcap.sections import Container
from sensors.records import Log
from tests.sensors.mcap.clouds import frames, pose
from tests.sensors.mcap.messages import START_NS
from tests.sensors.pictures import image

MS = 1_000_000
LENSES = [
    {},
    {"lens": "plumb_bob", "distortion": [-0.3, 0.1, 1e-3, 2e-3, 0.01]},
    {"lens": "rational", "distortion": [0.4, -0.1, 2e-4, 1e-4, 0.01, 0.7, 0.02, 0.001]},
    {"lens": "fisheye", "distortion": [0.02, -0.01, 0.003, -4e-4]},
]
KINDS = ("jpeg", "png", "rgb8", "bgr8", "mono8")


def with_images(count: int, cameras: int = 2, lidars: int = 1) -> list[Frame]:
    """Frames with images of each camera, taken one after the other from 20 ms before the frame on."""
    return [
        replace(
            frame,
            images=tuple(
                image(frame.t_ns + (7 * i - 20) * MS, f"ring/camera_{i}", KINDS[i % 5], i, **LENSES[i % 4])  # type: ignore[arg-type]
                for i in range(cameras)
            ),
        )
        for frame in frames(count, lidars=lidars)
    ]


def assert_same(got: list[Frame], sent: list[Frame]) -> None:
    """All of the images to the bit, but for T_body_camera, which went through a quaternion."""
    assert [(f.t_ns, f.arrival_ns, len(f.sweeps)) for f in got] == [(f.t_ns, f.arrival_ns, len(f.sweeps)) for f in sent]
    for one, other in zip(got, sent, strict=True):
        for a, b in zip(one.images, other.images, strict=True):
            for name in ("data", "format", "width", "height", "t_ns", "name", "lens"):
                assert getattr(a, name) == getattr(b, name)
            np.testing.assert_array_equal(a.K, b.K)
            np.testing.assert_array_equal(a.distortion, b.distortion)
            np.testing.assert_allclose(a.T_body_camera, b.T_body_camera, rtol=0, atol=1e-14)


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_images_come_back(tmp_path: Path, log: Log, compression: str) -> None:
    sent = with_images(4, cameras=5, lidars=2)
    write_log(tmp_path / "a.mcap", log, compression, sent)  # type: ignore[arg-type]
    reader = FrameReader(tmp_path / "a.mcap")
    assert_same(list(reader.frames()), sent)
    assert reader.left_out == ()
    assert read_log(tmp_path / "a.mcap").left_out == ()


def test_a_log_of_images_alone(tmp_path: Path) -> None:
    """Each frame has the stamp of its first image; a log with LiDARs gives them by themselves on request."""
    sent = [
        Frame(f.images[0].t_ns, f.arrival_ns, (), tuple(sorted(f.images, key=lambda i: i.t_ns)))
        for f in with_images(4, 3)
    ]
    write_log(tmp_path / "a.mcap", Log(), frames=sent)
    assert_same(list(read_frames(tmp_path / "a.mcap")), sent)
    write_log(tmp_path / "b.mcap", Log(), frames=with_images(4, 3))
    assert_same(list(read_frames(tmp_path / "b.mcap", ())), sent)


def test_without_images_their_chunks_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = with_images(20, cameras=3)
    write_log(tmp_path / "a.mcap", Log(), frames=sent)
    read: list[object] = []
    decompressed = Container._decompressed
    monkeypatch.setattr(Container, "_decompressed", lambda self, c: read.append(c) or decompressed(self, c))  # type: ignore[func-returns-value]
    found = list(read_frames(tmp_path / "a.mcap", images=False))
    assert [(f.t_ns, len(f.sweeps), f.images) for f in found] == [(f.t_ns, 1, ()) for f in sent]
    assert len(read) == 20 + 1  # sweeps, and /tf_static
    read.clear()
    only = list(read_frames(tmp_path / "a.mcap", cameras="/camera/ring/camera_1/image/compressed"))
    assert_same(only, [replace(f, images=f.images[1:2]) for f in sent])
    assert len(read) <= 20 + 20 + 3 + 2  # sweeps, images, the first CameraInfos, /tf_static, a look at what there is


def test_each_image_is_of_the_nearest_frame(tmp_path: Path) -> None:
    """A camera of 30 Hz and a LiDAR of 10 Hz: the nearest is taken; far from any sweep an image is left out."""
    sweeps = frames(10)
    del sweeps[5]
    stamps = START_NS + np.arange(-3, 33, dtype=np.int64) * 33_300_000 + 3 * MS
    path = tmp_path / "a.mcap"
    loose = [Frame(int(t), int(t) + 30 * MS, (), (image(int(t)),)) for t in stamps]
    write_log(path, Log(), frames=sorted((*sweeps, *loose), key=lambda frame: frame.t_ns))
    reader = FrameReader(path)
    found = list(reader.frames())
    assert [frame.t_ns for frame in found] == [frame.t_ns for frame in sweeps]
    chosen = [frame.images[0].t_ns for frame in found]
    expected = [int(stamps[np.abs(stamps - frame.t_ns).argmin()]) for frame in sweeps]
    assert chosen == expected
    far = sum(min(abs(int(t) - frame.t_ns) for frame in sweeps) > 50 * MS for t in stamps)
    assert far > 2
    (left,) = reader.left_out
    assert (left.source, left.count) == ("/camera/front/image/compressed", far)
    assert left.reason == "images with no sweep within 0.05 s"
    by_array = nearest(np.array([frame.t_ns for frame in sweeps]), stamps)
    assert stamps[by_array].tolist() == chosen


def test_nearest_in_corner_cases() -> None:
    def of(frames: list[int], images: list[int]) -> list[int]:
        return nearest(np.array(frames, np.int64) * MS, np.array(images, np.int64) * MS).tolist()

    assert of([], [1]) == []
    assert of([0, 100], []) == [-1, -1]
    assert of([0], [-51, -50, 60]) == [1]
    assert of([0, 100], [50]) == [0, -1]  # half way: the earlier frame's
    assert of([0, 100], [-10, 10, 100]) == [0, 2]  # the earlier of two as near


def test_other_tools_read_images_and_cameras(tmp_path: Path) -> None:
    sent = with_images(2, cameras=4)
    write_log(tmp_path / "a.mcap", Log(), frames=sent)
    with (tmp_path / "a.mcap").open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    by_topic = {channel.topic: value for _, channel, _, value in reversed(decoded)}
    first = sent[0].images
    jpeg = by_topic["/camera/ring/camera_0/image/compressed"]
    assert (jpeg.format, bytes(jpeg.data), jpeg.header.frame_id) == ("jpeg", first[0].data, "camera/ring/camera_0")
    assert jpeg.header.stamp.sec * 10**9 + jpeg.header.stamp.nanosec == first[0].t_ns
    raw = by_topic["/camera/ring/camera_2/image"]
    assert (raw.encoding, raw.width, raw.height, raw.step) == ("rgb8", 64, 48, 192)
    infos = [by_topic[f"/camera/ring/camera_{i}/camera_info"] for i in range(4)]
    assert [info.distortion_model for info in infos] == [
        "plumb_bob",
        "plumb_bob",
        "rational_polynomial",
        "equidistant",
    ]
    assert [list(info.d) for info in infos] == [[0.0] * 5, *(lens["distortion"] for lens in LENSES[1:])]
    assert (infos[0].width, infos[0].height, list(infos[0].k)) == (64, 48, first[0].K.ravel().tolist())
    assert list(infos[0].p) == np.hstack((first[0].K, np.zeros((3, 1)))).ravel().tolist()
    (static,) = [value for _, channel, _, value in decoded if channel.topic == "/tf_static"]
    assert [t.child_frame_id for t in static.transforms] == ["lidar", *(f"camera/ring/camera_{i}" for i in range(4))]


def test_images_are_held_for_some_tenths_of_a_second(tmp_path: Path) -> None:
    """However many there are: what waits for its frame is dropped with it."""
    import weakref

    write_log(tmp_path / "a.mcap", Log(), frames=with_images(60, cameras=1))
    alive, most = weakref.WeakSet[Image](), 0
    made = Image.__post_init__

    def noted(self: Image) -> None:
        nonlocal most
        made(self)
        alive.add(self)
        most = max(most, len(alive))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Image, "__post_init__", noted)
        assert sum(1 for _ in read_frames(tmp_path / "a.mcap")) == 60
    assert most <= 6


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (
            {"t_ns": START_NS + 200 * MS},
            "image of front at .*: expected a stamp within 50 ms of the frame's",
        ),
        ({"T_body_camera": pose(4)}, "expected T_body_camera, size, K, lens and format of the camera's first image"),
        ({"K": np.diag([40.0, 40.0, 1.0])}, "expected T_body_camera, size, K"),
        ({"kind": "rgb8"}, "expected T_body_camera, size, K, lens and format"),
    ],
)
def test_images_that_a_log_cannot_hold(tmp_path: Path, changed: dict[str, object], told: str) -> None:
    first, second = frames(2)
    sent = [
        replace(first, images=(image(first.t_ns),)),
        replace(second, images=(image(**({"t_ns": second.t_ns} | changed)),)),  # type: ignore[arg-type]
    ]
    with pytest.raises(EgolocError, match=told):
        write_log(tmp_path / "a.mcap", Log(), frames=sent)
    assert list(tmp_path.iterdir()) == []


def test_what_a_log_tells_of_its_cameras(tmp_path: Path, log: Log) -> None:
    write_log(tmp_path / "a.mcap", log, frames=with_images(20))
    first, second = camera_topics(tmp_path / "a.mcap")
    assert (first.name, first.camera) == ("/camera/ring/camera_0/image/compressed", "ring/camera_0")
    assert (second.width, second.height, second.format, second.lens) == (64, 48, "png", "plumb_bob")
    assert first.place == pytest.approx(pose(3)[:3, 3])
    told = {topic.name: topic for topic in describe(tmp_path / "a.mcap").topics}
    assert told[first.name].sensors == told["/camera/ring/camera_0/camera_info"].sensors == ("camera",)
    assert told[first.name].median_rate_hz == pytest.approx(10.0)
    assert [c.name for c in camera_topics(tmp_path / "a.mcap", second.name)] == [second.name]
    with pytest.raises(EgolocError, match=r"topics\.camera: no topic /front; the log has "):
        camera_topics(tmp_path / "a.mcap", "/front")
    with pytest.raises(EgolocError, match=r"topics\.camera: /imu has schema .*Imu, expected sensor_msgs/C"):
        list(read_frames(tmp_path / "a.mcap", cameras="/imu"))
