"""Pillars against a loop over points, and the LiDAR encoder."""

import math

import pytest
import torch

from egovm.batch import Points
from egovm.lidar_encoder import LidarEncoder, PillarEncoder
from tests.egovm.scenes import TINY, no_points, points


def pillars() -> PillarEncoder:
    torch.manual_seed(0)
    assert TINY.lidar is not None
    return PillarEncoder(TINY.lidar, TINY.bev)


def test_pillars_are_those_of_a_loop() -> None:
    encoder, given = pillars(), points(300, frames=2)
    canvas, present = encoder(given)
    cell, n = 0.25, 64
    inside: dict[tuple[int, int, int], list[int]] = {}
    for p, (x, y, z) in enumerate(given.xyz.tolist()):
        row, column = math.floor(x / cell) + n // 2, math.floor(y / cell) + n // 2
        if 0 <= row < n and 0 <= column < n and -3.0 <= z < 5.0:
            inside.setdefault((int(given.frame[p]), row, column), []).append(p)
    assert len(inside) > 100
    assert any(len(found) > 1 for found in inside.values())
    expected = torch.zeros_like(canvas)
    for (frame, row, column), found in inside.items():
        xyz = given.xyz[found]
        middle = torch.tensor([(row - n // 2 + 0.5) * cell, (column - n // 2 + 0.5) * cell])
        height = (xyz[:, 2:] - 1.0) / 4.0
        alone = torch.full((len(found), 1), float(len(found) == 1))
        known = torch.cat(
            (2 * (xyz[:, :2] - middle) / cell, (xyz - xyz.mean(0)) / cell, height, given.intensity[found, None], alone),
            -1,
        )
        expected[frame, :, row, column] = encoder.layers(known).amax(0)
    torch.testing.assert_close(canvas, expected, atol=1e-5, rtol=1e-5)
    assert present.tolist() == [True, True]


def test_order_of_points_is_nothing() -> None:
    encoder, given = pillars(), points(300)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(3))
    turned = Points(given.xyz[order], given.intensity[order], given.offset_s[order], given.frame[order], 1)
    torch.testing.assert_close(encoder(turned)[0], encoder(given)[0], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("cells", [(4, 0), (-3, 8)])
def test_a_thing_looks_the_same_in_every_place(cells: tuple[int, int]) -> None:
    encoder, given = pillars(), points(200, half_m=4.0)
    moved = given.xyz + 0.25 * torch.tensor((*map(float, cells), 0.0))
    there, _ = encoder(Points(moved, given.intensity, given.offset_s, given.frame, 1))
    torch.testing.assert_close(there, encoder(given)[0].roll(cells, (2, 3)), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("training", [True, False])
def test_nothing_seen(training: bool) -> None:
    assert TINY.lidar is not None
    encoder = LidarEncoder(TINY.lidar, TINY.bev).train(training)
    far = points(50)
    beyond = Points(far.xyz + 100.0, far.intensity, far.offset_s, far.frame, 1)
    for given in (no_points(), beyond):
        found = encoder(given)
        assert found.present.tolist() == [False]
        assert found.features.isfinite().all()
        assert encoder.pillars(given)[0].abs().max() == 0.0


def test_one_point_trains() -> None:
    assert TINY.lidar is not None
    encoder = LidarEncoder(TINY.lidar, TINY.bev)
    found = encoder(Points(torch.tensor([[1.0, 2.0, 0.0]]), torch.ones(1), torch.zeros(1), torch.zeros(1).long(), 2))
    found.features.square().mean().backward()
    assert found.present.tolist() == [True, False]
    assert all(p.grad is not None and p.grad.isfinite().all() for p in encoder.parameters() if p.grad is not None)
    assert encoder.pillars.layers[0].weight.grad is not None
