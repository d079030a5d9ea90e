"""BEV queries looking at images: what reaches which cell, in closed form."""

import math

import msgspec
import torch
from torch import Tensor

from egovm.bev_fusion import BevFusion, ImageAttention, pillar_anchors
from egovm.bev_grid import BevGrid
from egovm.camera_encoder import STRIDE
from egovm.camera_projection import feature_cells, project
from tests.egovm.scenes import FOCAL, TINY, images


def plain_attention(channels: int, points: int, anchors: int) -> ImageAttention:
    """One head that reads at its references and hands on what it reads."""
    found = ImageAttention(channels, 1, points, anchors)
    with torch.no_grad():
        found.attention.offsets.bias.zero_()
        for layer in (found.attention.values, found.attention.out):
            layer.weight.copy_(torch.eye(channels))
            layer.bias.zero_()
    return found


def random_attention() -> ImageAttention:
    torch.manual_seed(4)
    found = ImageAttention(8, heads=2, points=4, anchors=2)
    torch.nn.init.normal_(found.attention.offsets.weight)
    torch.nn.init.normal_(found.attention.weights.weight)
    return found


def anchors_in_features(heights_m: tuple[float, ...], yaws: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Cells (1, N, Q, A, 2) and whether they are seen (1, N, Q, A), of a plane of 16 x 16 cells of 1 m."""
    anchors = pillar_anchors(BevGrid(16, 1.0), heights_m)
    pixels, seen = project(anchors.flatten(0, 1), images(yaws))
    shape = (1, len(yaws), 256, len(heights_m))
    return feature_cells(pixels, STRIDE).reshape(*shape, 2), seen.reshape(shape)


def test_a_feature_reaches_the_bev_cell_before_the_camera() -> None:
    """A cell 5.5 m ahead and 1.5 m left, 0.5 m up: 60 * 1.5 / 5.5 px left, 60 * 1 / 5.5 px down of the middle."""
    row = (31.5 + FOCAL * 1.0 / 5.5 + 0.5) / 16 - 0.5
    column = (47.5 - FOCAL * 1.5 / 5.5 + 0.5) / 16 - 0.5
    features = torch.zeros(1, 1, 1, 4, 6)
    features[0, 0, 0, math.floor(row), math.floor(column)] = 1.0
    cells, seen = anchors_in_features((0.5,), (0.0,))
    found = plain_attention(1, 1, 1)(torch.zeros(1, 256, 1), features, cells, seen).reshape(16, 16)
    expected = (1.0 - row % 1.0) * (1.0 - column % 1.0)
    at = BevGrid(16, 1.0).cells_from_m(torch.tensor([5.5, 1.5])).long()
    torch.testing.assert_close(found[tuple(at)], torch.tensor(expected))
    assert found[:8].abs().max() == 0.0  # behind the camera
    assert found[13, 4] == 0.0  # as far ahead, to the right


def test_heights_share_what_is_read() -> None:
    """Of two anchors of a cell one is above the image: half of the weight is gone, not shared out."""
    cells, seen = anchors_in_features((1.5, 9.0), (0.0,))
    at = 16 * 13 + 8
    assert seen[0, 0, at].tolist() == [True, False]
    found = plain_attention(1, 2, 2)(torch.zeros(1, 256, 1), torch.ones(1, 1, 1, 4, 6), cells, seen)
    torch.testing.assert_close(found[0, at], torch.tensor([0.5]))


def test_cells_that_no_camera_sees_get_nothing() -> None:
    cells, seen = anchors_in_features((0.0, 1.5), (0.0,))
    attention = plain_attention(1, 2, 2)
    with torch.no_grad():
        attention.attention.out.bias.fill_(3.0)
    found = attention(torch.zeros(1, 256, 1), torch.ones(1, 1, 1, 4, 6), cells, seen)
    unseen = ~seen.any(-1).any(1)[0]
    assert 100 < unseen.sum() < 256
    assert found[0, unseen].abs().max() == 0.0
    assert found[0, ~unseen].min() > 3.0


def test_cameras_are_averaged() -> None:
    queries, features = torch.randn(1, 256, 8), torch.randn(1, 1, 8, 4, 6)
    attention = random_attention()
    once = attention(queries, features, *anchors_in_features((0.0, 1.5), (0.0,)))
    twice = attention(queries, features.expand(1, 2, -1, -1, -1), *anchors_in_features((0.0, 1.5), (0.0, 0.0)))
    torch.testing.assert_close(twice, once, atol=1e-5, rtol=1e-5)


def test_computing_only_what_is_seen_changes_nothing() -> None:
    attention = random_attention()
    given = (torch.randn(1, 256, 8), torch.randn(1, 3, 8, 4, 6), *anchors_in_features((0.0, 1.5), (0.0, 1.0, 3.0)))
    packed = attention(*given)
    attention.dense = True
    torch.testing.assert_close(packed, attention(*given), atol=1e-5, rtol=1e-5)


def test_images_do_not_run_into_each_other() -> None:
    """They lie below one another when they are read: what one query finds depends on its own camera's image alone."""
    attention = random_attention()
    cells, seen = anchors_in_features((0.0, 1.5), (0.0, math.pi))
    queries, features = torch.randn(1, 256, 8), torch.randn(1, 2, 8, 4, 6)
    changed = features.clone()
    changed[:, 1] += 10.0
    before, after = attention(queries, features, cells, seen), attention(queries, changed, cells, seen)
    only_first = seen[0, 0].any(-1) & ~seen[0, 1].any(-1)
    assert only_first.sum() > 20
    assert torch.equal(before[0, only_first], after[0, only_first])


def test_gradients_of_what_is_read() -> None:
    attention = random_attention().double()
    cells, seen = anchors_in_features((0.0, 1.5), (0.0,))
    few = torch.tensor([16 * 13 + 8, 16 * 12 + 5, 3])
    cells, seen = cells[:, :, few].double(), seen[:, :, few]
    queries = torch.randn(1, 3, 8, dtype=torch.float64, requires_grad=True)
    features = torch.randn(1, 1, 8, 4, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda q, f: attention(q, f, cells, seen), (queries, features), fast_mode=True)


def test_coarser_queries_add_to_a_finer_map() -> None:
    torch.manual_seed(6)
    fusion = BevFusion(msgspec.structs.replace(TINY, fusion=msgspec.structs.replace(TINY.fusion, cell_m=1.0)))
    bev, features = torch.randn(1, 16, 32, 32), torch.randn(1, 2, 16, 4, 6)
    fused = fusion(bev, features, images())
    assert fused.shape == bev.shape
    assert len(fusion.anchors) == 16 * 16
    added = fused - bev
    assert added.isfinite().all()
    assert (added.reshape(16, 16, 2, 16, 2).amax((2, 4)) > added.reshape(16, 16, 2, 16, 2).amin((2, 4))).all()
