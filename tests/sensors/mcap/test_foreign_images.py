"""Images of other recorders: names, CameraInfo, binning and rectification, several topics of a camera, mistakes."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensors.frames import Frame
from sensors.mcap.camera_summary import camera_topics
from sensors.mcap.frames import FrameReader
from tests.sensors.mcap.clouds import cloud_value, points_of, pose, transform_value
from tests.sensors.mcap.messages import START_NS, Sent, header
from tests.sensors.pictures import encoded, pixels

K = [50.0, 0.0, 31.5, 0.0, 52.0, 23.5, 0.0, 0.0, 1.0]
Save = Callable[..., Path]


def compressed(topic: str = "/front/image_raw/compressed", frame: str = "optical", **other: Any) -> Sent:
    value = {
        "header": header(START_NS, frame),
        "format": "rgb8; jpeg compressed bgr8",
        "data": encoded(pixels(), "jpeg"),
    }
    return Sent(topic, "sensor_msgs/CompressedImage", value | other, START_NS + 1)


def raw(topic: str = "/front/image_raw", encoding: str = "bgr8", pad: int = 0, **other: Any) -> Sent:
    data = encoded(pixels(), encoding)  # type: ignore[arg-type]
    step = len(data) // 48
    rows = b"".join(data[k * step : (k + 1) * step] + bytes(pad) for k in range(48))
    value = {
        "header": header(START_NS, "optical"), "height": 48, "width": 64, "encoding": encoding, "is_bigendian": 0,
        "step": step + pad, "data": rows,
    }  # fmt: skip
    return Sent(topic, "sensor_msgs/Image", value | other, START_NS + 1)


def info(topic: str = "/front/camera_info", **other: Any) -> Sent:
    value = {
        "header": header(START_NS, "optical"), "height": 48, "width": 64, "distortion_model": "plumb_bob",
        "d": [-0.3, 0.1, 0.0, 0.0, 0.0], "k": K, "r": np.eye(3).ravel().tolist(),
        "p": [60.0, 0.0, 30.0, 0.0, 0.0, 61.0, 20.0, 0.0, 0.0, 0.0, 1.0, 0.0], "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip
    return Sent(topic, "sensor_msgs/CameraInfo", value | other, START_NS)


def bayer() -> Sent:
    sent = raw(encoding="mono8")
    assert isinstance(sent.value, dict)
    return sent._replace(value=sent.value | {"encoding": "bayer_rggb8"})


def static(frame: str = "optical") -> Sent:
    value = {"transforms": [transform_value("base_link", "mount", pose(1)), transform_value("mount", frame, pose(2))]}
    return Sent("/tf_static", "tf2_msgs/TFMessage", value, START_NS)


def read(path: Path, **options: Any) -> tuple[Frame | None, dict[str, str]]:
    """The one frame, None where there is none, and why topics were left out."""
    reader = FrameReader(path, **options)
    found = list(reader.frames())
    assert len(found) <= 1
    return (found[0] if found else None), {entry.source: entry.reason for entry in reader.left_out}


@pytest.mark.parametrize(
    ("topic", "place", "name"),
    [
        ("/front/image_raw/compressed", "/front/camera_info", "front"),
        ("/camera/front/image/compressed", "/camera/front/camera_info", "front"),
        (
            "/sensing/camera/camera0/image_raw/compressed",
            "/sensing/camera/camera0/camera_info",
            "sensing/camera/camera0",
        ),
        ("/CAM_BACK/compressed", "/CAM_BACK/camera_info", "CAM_BACK"),
        ("/image_raw/compressed", "/camera_info", "camera"),
    ],
)
def test_cameras_are_named_by_their_topics(save: Save, topic: str, place: str, name: str) -> None:
    frame, left_out = read(save([static(), info(place), compressed(topic)]))
    assert frame is not None
    (image,) = frame.images
    assert (image.name, image.format, image.lens, left_out) == (name, "jpeg", "plumb_bob", {})
    np.testing.assert_allclose(image.T_body_camera, pose(1) @ pose(2), atol=1e-12)
    np.testing.assert_array_equal(image.K, np.reshape(K, (3, 3)))


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
@pytest.mark.parametrize("pad", [0, 5])
def test_raw_images(save: Save, encoding: str, pad: int) -> None:
    frame, _ = read(save([static(), info(), raw(encoding=encoding, pad=pad)]))
    assert frame is not None
    expected = np.repeat(pixels()[..., :1], 3, -1) if encoding == "mono8" else pixels()
    np.testing.assert_array_equal(frame.images[0].rgb(), expected)


def test_rectified_images_have_the_projection_of_their_info(save: Save) -> None:
    """P instead of K, no lens, and axes turned by R (image = R camera)."""
    R = pose(5)[:3, :3]
    frame, _ = read(save([static(), info(r=R.ravel().tolist()), compressed("/front/image_rect_color/compressed")]))
    assert frame is not None
    (image,) = frame.images
    assert (image.lens, len(image.distortion)) == ("none", 0)
    np.testing.assert_array_equal(image.K, [[60.0, 0.0, 30.0], [0.0, 61.0, 20.0], [0.0, 0.0, 1.0]])
    mounted = pose(1) @ pose(2)
    np.testing.assert_allclose(image.T_body_camera[:3, :3], mounted[:3, :3] @ R.T, atol=1e-12)
    np.testing.assert_allclose(image.T_body_camera[:3, 3], mounted[:3, 3], atol=1e-12)


def test_binning_and_region_are_put_into_the_intrinsics(save: Save) -> None:
    """A place in pixels of the whole sensor appears where cutting out and averaging 2 x 2 pixels puts it."""
    roi = {"x_offset": 10, "y_offset": 20, "height": 96, "width": 128, "do_rectify": False}
    whole = [100.0, 0.0, 80.0, 0.0, 100.0, 70.0, 0.0, 0.0, 1.0]
    found, _ = read(
        save([static(), info(k=whole, roi=roi, binning_x=2, binning_y=2, width=200, height=150), compressed()])
    )
    assert found is not None
    x, y = 0.3, -0.2
    u, v, _ = found.images[0].K @ (x, y, 1.0)
    assert u == pytest.approx((100.0 * x + 80.0 - 10.0 + 0.5) / 2.0 - 0.5)
    assert v == pytest.approx((100.0 * y + 70.0 - 20.0 + 0.5) / 2.0 - 0.5)


def test_of_several_topics_of_a_camera_one_is_read(save: Save) -> None:
    messages = [static(), info(), raw(), compressed(), compressed("/front/image_color/compressed")]
    frame, left_out = read(save(messages))
    assert frame is not None
    assert [image.format for image in frame.images] == ["jpeg"]
    told = "camera front is read from /front/image_raw/compressed; name another under topics.camera"
    assert left_out == {"/front/image_raw": told, "/front/image_color/compressed": told}
    named, left_out = read(save(messages), cameras="/front/image_raw")
    assert named is not None
    assert ([image.format for image in named.images], left_out) == (["bgr8"], {})


@pytest.mark.parametrize(
    ("messages", "told"),
    [
        ([static(), compressed()], "no CameraInfo on /front/camera_info"),
        ([info(), compressed()], "no /tf_static leads from base_link to 'optical'"),
        ([static(), info(k=[0.0] * 9), compressed()], "/front/camera_info: CameraInfo: the camera is not calibrated"),
        ([static(), info(distortion_model="ds"), compressed()], "expected distortion_model none, .*, got 'ds'"),
        ([static(), info(d=[0.1] * 7), compressed()], "Image.distortion: expected 4 or 5 numbers for plumb_bob, got 7"),
        ([static(), info(width=128), compressed()], "another size than their CameraInfo says: 128 x 48 pixels"),
        ([static(), info(), compressed(data=b"abc")], "expected images as JPEG or PNG, got format 'rgb8; jpeg"),
        ([static(), info(), compressed(data=b"\xff\xd8\xff\xe0")], "image of the message: "),
        ([static(), info(), compressed(format="16UC1; compressedDepth png")], "got format '16UC1; compressedDepth"),
        ([static(), info(), bayer()], "got encoding 'bayer_rggb8'"),
        ([static(), info(), raw(data=b"abc")], "data is shorter than height, width and step say"),
    ],
)  # fmt: skip
def test_images_that_cannot_be_used_are_left_out_with_the_reason(save: Save, messages: list[Sent], told: str) -> None:
    cloud = cloud_value(points_of([[1, 2, 3]]), START_NS)
    path = save([*messages, Sent("/points", "sensor_msgs/PointCloud2", cloud, START_NS)])
    frame, left_out = read(path)
    assert frame is not None
    assert (len(frame.sweeps), frame.images) == (1, ())
    (reason,) = left_out.values()
    assert re.search(told, reason), reason
    (topic,) = camera_topics(path)
    assert topic.problem == reason


def test_without_an_index_images_come_back_too(save: Save) -> None:
    frame, left_out = read(save([compressed(), info(), static()], use_chunking=False))
    assert frame is not None
    assert ([image.name for image in frame.images], left_out) == (["front"], {})


def test_a_map_of_points_is_no_sweep(save: Save) -> None:
    """Clouds in map axes do not keep images from being frames of their own."""
    cloud = cloud_value(points_of([[1, 2, 3]]), START_NS - 10**9, "map")
    path = save([static(), info(), Sent("/map", "sensor_msgs/PointCloud2", cloud, START_NS), compressed()])
    frame, left_out = read(path)
    assert frame is not None
    assert (frame.t_ns, frame.sweeps, len(frame.images), list(left_out)) == (START_NS, (), 1, ["/map"])
