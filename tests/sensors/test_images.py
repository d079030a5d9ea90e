"""Images: where places appear by closed form and by another's formulas, decoding, and what is no image."""

import math

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.images import Image
from sensors.lens import COEFFICIENTS, Lens, pixels_of, widest
from tests.sensors.pictures import AHEAD, encoded, image, pixels

K = np.array([[1000.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]])
BENT: dict[Lens, list[float]] = {
    "plumb_bob": [-0.28, 0.07, 1e-3, -5e-4, -0.01],
    "rational": [0.4, -0.1, 2e-4, 1e-4, 0.01, 0.7, 0.02, 0.001],
    "fisheye": [0.02, -0.01, 0.003, -0.0004],
}


def test_a_point_ahead_lands_on_its_pixel() -> None:
    """Ten metres ahead of the camera, two to the left and one above it: u = 320 - 1000 * 2 / 10, v = 240 - 900 / 10."""
    made = image(0, kind="rgb8", data=bytes(640 * 480 * 3), width=640, height=480, K=K, T_body_camera=AHEAD)
    seen = made.seen(np.array([[11.5, 2.0, 2.2], [11.5, 0.0, 1.2], [-8.5, 0.0, 1.2], [11.5, 3.3, 1.2], [1.55, 0, 1.2]]))
    np.testing.assert_allclose(seen.pixels[:2], [[120.0, 150.0], [320.0, 240.0]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(seen.depth[:2], 10.0)
    assert seen.inside.tolist() == [True, True, False, False, False]  # behind, beside, too close


def test_the_edge_is_half_a_pixel_beyond_the_last_middle() -> None:
    made = image(0, kind="rgb8", data=bytes(640 * 480 * 3), width=640, height=480, K=K, T_body_camera=np.eye(4))
    u = np.array([-0.51, -0.49, 639.49, 639.51])
    seen = made.seen(np.column_stack(((u - 320.0) / 1000.0, np.zeros(4), np.ones(4))))
    assert seen.inside.tolist() == [False, True, True, False]


@pytest.mark.parametrize("lens", BENT)
def test_lenses_agree_with_their_formulas_written_out(lens: Lens) -> None:
    """One place, by the equations in OpenCV's documentation of camera calibration and of the fisheye module."""
    x, y = 0.31, -0.22
    d = BENT[lens]
    r = math.hypot(x, y)
    if lens == "fisheye":
        theta = math.atan(r)
        bent = theta * (1 + d[0] * theta**2 + d[1] * theta**4 + d[2] * theta**6 + d[3] * theta**8)
        expected = x * bent / r, y * bent / r
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*d, 0.0, 0.0, 0.0)[:8]
        scale = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        expected = (
            x * scale + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            y * scale + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
        )
    found, ahead = pixels_of(np.array([[3.0 * x, 3.0 * y, 3.0]]), K, lens, np.array(d))
    assert ahead.all()
    np.testing.assert_allclose(found[0], [320 + 1000 * expected[0], 240 + 900 * expected[1]], rtol=0, atol=1e-9)


def test_what_a_polynomial_folds_back_is_not_seen() -> None:
    """r (1 - 0.28 r^2) turns back at r = 1 / sqrt(0.84): further aside it would appear within the image again."""
    d = np.array([-0.28, 0.0, 0.0, 0.0])
    assert widest("plumb_bob", d) == pytest.approx(1.0 / math.sqrt(0.84), abs=0.01)
    _, seen = pixels_of(np.array([[1.0, 0.0, 1.0], [1.8, 0.0, 1.0]]), K, "plumb_bob", d)
    assert seen.tolist() == [True, False]
    assert 320.0 + 1000.0 * 1.8 * (1.0 - 0.28 * 1.8**2) < 640.0


@pytest.mark.parametrize("lens", BENT)
def test_rectified_is_what_a_pinhole_sees(lens: Lens) -> None:
    """The colour of each pixel of the rectified image is that of the place where the lens took its ray."""
    smooth = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
    column, row = np.meshgrid(np.arange(320), np.arange(240))
    ramp = np.stack((column * 0.75, row, 255 - row * 0.5), -1).round().astype(np.uint8)
    made = Image(ramp.tobytes(), "rgb8", 320, 240, smooth, np.eye(4), 0, "a", lens, np.array(BENT[lens]))
    found = made.rectified().astype(float)
    assert np.abs(found - ramp).max() > 3.0  # the lens does bend
    for u, v in ((160, 120), (60, 40), (250, 200), (20, 120)):
        at = made.seen(np.array([[(u - 160.0) / 300.0, (v - 120.0) / 300.0, 1.0]]))
        assert at.inside.all()
        expected = [at.pixels[0, 0] * 0.75, at.pixels[0, 1], 255 - at.pixels[0, 1] * 0.5]
        np.testing.assert_allclose(found[v, u], expected, rtol=0, atol=1.1)


def test_formats_are_decoded_as_they_were() -> None:
    rgb = pixels()
    for kind in ("png", "rgb8", "bgr8"):
        np.testing.assert_array_equal(image(0, kind=kind).rgb(), rgb)  # type: ignore[arg-type]
    np.testing.assert_array_equal(image(0, kind="mono8").rgb(), np.repeat(rgb[..., :1], 3, -1))
    assert np.abs(image(0, kind="jpeg").rgb().astype(int) - rgb).mean() < 4.0


@pytest.mark.parametrize("size", [(400, 300), (333, 211), (97, 71)])
def test_a_small_jpeg_shows_the_same_places(size: tuple[int, int]) -> None:
    """Of a width and height that no power of two divides: decoded small and decoded whole are less than 0.05 pixels of
    the small image apart (the shift that explains their difference best), and a pixel is the mean of those it covers.
    """
    width, height = 1003, 701
    rgb = pixels(width, height)
    given = {"width": width, "height": height}
    found = image(0, data=encoded(rgb, "jpeg"), **given).small(*size).astype(float)
    whole = image(0, kind="rgb8", data=rgb.tobytes(), **given).small(*size).astype(float)
    assert found.shape == (size[1], size[0], 3)
    slopes = np.stack([np.gradient(whole, axis=axis).ravel() for axis in (0, 1)], axis=-1)
    shift = np.linalg.lstsq(slopes, (whole - found).ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.05
    assert np.abs(found - whole).mean() < 2.0
    u, v = size[0] // 2, size[1] // 3
    row, column = ((v + 0.5) * height / size[1] - 0.5), ((u + 0.5) * width / size[0] - 0.5)
    np.testing.assert_allclose(whole[v, u], rgb[round(row), round(column)], rtol=0, atol=4.0)


def test_images_that_cannot_be_decoded() -> None:
    with pytest.raises(EgolocError, match="image of front: expected 65 x 48 pixels, got 64 x 48"):
        image(0, width=65).rgb()
    with pytest.raises(EgolocError, match="image of front: expected a JPEG or PNG"):
        image(0, data=b"nothing").rgb()
    with pytest.raises(EgolocError, match="image of front: cannot be decoded"):
        image(0, data=encoded(pixels(), "png")[:200], kind="png").rgb()
    deep = np.zeros((48, 64), np.uint16)
    with pytest.raises(EgolocError, match="expected 8 bits a colour, got mode I;16"):
        image(0, data=encoded(deep, "png"), kind="png").rgb()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"format": "tiff"}, "Image.format: expected one of jpeg, png"),
        ({"width": 0}, "Image.width, height: expected 1 to 32767, got 0 x 48"),
        ({"K": np.eye(4)}, r"Image.K: expected shape \(3, 3\), got \(4, 4\)"),
        ({"K": np.full((3, 3), np.nan)}, "Image.K: expected finite numbers"),
        ({"K": np.zeros((3, 3))}, "Image.K: expected fx, fy > 0"),
        ({"T_body_camera": 2.0 * np.eye(4)}, "Image.T_body_camera: expected a rigid transform"),
        ({"T_body_camera": np.full((4, 4), np.nan)}, "Image.T_body_camera: expected finite numbers"),
        ({"name": "front camera"}, "Image.name: expected letters"),
        ({"name": "front/"}, "Image.name: expected letters"),
        ({"lens": "wide"}, "Image.lens: expected one of none, plumb_bob"),
        ({"lens": "plumb_bob"}, "Image.distortion: expected 4 or 5 numbers for plumb_bob, got 0"),
        ({"lens": "fisheye", "distortion": [0.0, 0.0, np.inf, 0.0]}, "Image.distortion: expected finite"),
        ({"format": "rgb8"}, "Image.data: expected 9216 bytes of rgb8"),
    ],
)
def test_images_that_are_none(changed: dict[str, object], told: str) -> None:
    with pytest.raises(EgolocError, match=told):
        image(0, **changed)


def test_a_frame_has_one_image_of_each_camera() -> None:
    with pytest.raises(EgolocError, match=r"Frame\.images: expected one of each camera, got front, front"):
        Frame(0, 0, (), (image(0), image(1)))
    assert set(COEFFICIENTS) == {"none", *BENT}
