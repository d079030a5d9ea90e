"""Places in body axes to pixels, by hand and by turning everything together."""

import math

import pytest
import torch

from egovm.batch import Images
from egovm.camera_projection import feature_cells, project
from tests.egovm.scenes import FOCAL, images


def test_places_before_a_camera_by_hand() -> None:
    """The camera looks ahead from 1.5 m: 10 m ahead, 1 m to the left and 2 m up are 6 pixels left and 12 up."""
    places = torch.tensor([[10.0, 0.0, 1.5], [10.0, 1.0, 1.5], [10.0, 0.0, 3.5], [10.0, -2.0, 0.0]])
    pixels, seen = project(places, images((0.0,)))
    expected = torch.tensor([[31.5, 47.5], [31.5, 41.5], [19.5, 47.5], [40.5, 59.5]])
    torch.testing.assert_close(pixels[0, 0], expected)
    assert seen.all()


def test_what_is_not_seen() -> None:
    """Behind, right at the camera, beyond each edge of the image."""
    edge = 10.0 * 48.1 / FOCAL
    places = torch.tensor([[-10.0, 0.0, 1.5], [0.05, 0.0, 1.5], [10.0, edge, 1.5], [10.0, -edge, 1.5], [10.0, 0, 9.0]])
    pixels, seen = project(places, images((0.0,)))
    assert not seen.any()
    assert pixels.isfinite().all()
    assert project(torch.tensor([[10.0, 0.99 * edge, 1.5]]), images((0.0,)))[1].all()


def test_an_invalid_image_sees_nothing() -> None:
    given = images()
    valid = torch.tensor([[True, False]])
    _, seen = project(
        torch.tensor([[5.0, 0.0, 1.0], [-5.0, 0.0, 1.0]]), Images(given.rgb, given.K, given.T_camera_body, valid)
    )
    assert seen.tolist() == [[[True, False], [False, False]]]


@pytest.mark.parametrize("yaw", [0.3, math.pi / 2, -2.0])
def test_turning_cameras_and_places_together_changes_nothing(yaw: float) -> None:
    c, s = math.cos(yaw), math.sin(yaw)
    turn = torch.eye(4)
    turn[:2, :2] = torch.tensor([[c, -s], [s, c]])
    given = images((0.0, 1.0))
    turned = Images(given.rgb, given.K, given.T_camera_body @ turn.T, given.valid)
    places = torch.randn(40, 3, generator=torch.Generator().manual_seed(5)) * torch.tensor([10.0, 10.0, 1.0])
    pixels, seen = project(places, given)
    pixels_turned, seen_turned = project(places @ turn[:3, :3].T, turned)
    assert seen.any()
    assert torch.equal(seen, seen_turned)
    torch.testing.assert_close(pixels[seen], pixels_turned[seen], atol=1e-3, rtol=1e-4)


def test_features_lie_on_the_middles_of_their_pixels() -> None:
    """Cell 0 of stride 16 stands for pixels 0 to 15."""
    assert feature_cells(torch.tensor([7.5, -0.5, 15.5, 23.5]), 16).tolist() == [0.0, -0.5, 0.5, 1.0]


def test_autocast_does_not_blur_places() -> None:
    places = torch.tensor([[33.3, 7.7, 0.0]])
    exact, _ = project(places, images((0.0,)))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, _ = project(places, images((0.0,)))
    assert torch.equal(found, exact)
