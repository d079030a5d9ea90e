"""Deformable attention against a loop that follows its definition."""

import math

import pytest
import torch
from torch import Tensor

from egovm.deformable_attention import DeformableAttention, deformable_sum, sampled_sum
from sensors.errors import EgolocError


def naive(values: Tensor, cells: Tensor, weights: Tensor) -> Tensor:
    """The same sums, one bilinear reading after another."""
    groups, channels, height, width = values.shape
    out = torch.zeros(groups, cells.shape[1], channels, dtype=values.dtype)
    for g, m, p in torch.cartesian_prod(*(torch.arange(n) for n in weights.shape)).tolist():
        row, column = cells[g, m, p].tolist()
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            r, c = math.floor(row) + i, math.floor(column) + j
            if 0 <= r < height and 0 <= c < width:
                part = (1.0 - abs(row - r)) * (1.0 - abs(column - c))
                out[g, m] += weights[g, m, p] * part * values[g, :, r, c]
    return out


def summed(values: Tensor, cells: Tensor, weights: Tensor) -> Tensor:
    """Ours, of one map of each sample, in the order of axes of the loop."""
    by_pixel = values.permute(0, 2, 3, 1)[:, :, :, None]
    return deformable_sum(by_pixel, cells[:, :, None], weights[:, :, None])[:, :, 0]


def scene(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    torch.manual_seed(seed)
    values = torch.randn(2, 3, 5, 7, dtype=torch.float64)
    cells = torch.rand(2, 6, 4, 2, dtype=torch.float64) * torch.tensor((9.0, 11.0), dtype=torch.float64) - 2.0
    return values, cells, torch.rand(2, 6, 4, dtype=torch.float64)


def test_sums_are_those_of_the_loop() -> None:
    values, cells, weights = scene(1)
    torch.testing.assert_close(summed(values, cells, weights), naive(values, cells, weights))


def test_a_whole_number_is_the_middle_of_a_cell() -> None:
    values = torch.arange(12.0).reshape(1, 1, 3, 4)
    read = summed(values, torch.tensor([[[[2.0, 1.0]], [[0.0, 3.0]]]]), torch.ones(1, 2, 1))
    torch.testing.assert_close(read.flatten(), torch.tensor([9.0, 3.0]))


def test_outside_weighs_nothing() -> None:
    values = torch.ones(1, 1, 3, 4)
    outside = torch.tensor([[-1.0, 1.0], [3.0, 1.0], [1.0, -1.5], [1.0, 4.0]])[None, :, None]
    assert summed(values, outside, torch.ones(1, 4, 1)).abs().max() == 0.0


def test_gradients() -> None:
    values, cells, weights = scene(2)
    assert torch.autograd.gradcheck(summed, [x.requires_grad_() for x in (values, cells, weights)])


def many(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Three maps of each of two samples, read at places some of which lie outside."""
    torch.manual_seed(seed)
    cells = torch.rand(2, 6, 3, 4, 2, dtype=torch.float64) * torch.tensor((9.0, 11.0), dtype=torch.float64) - 2.0
    return torch.randn(2, 5, 7, 3, 4, dtype=torch.float64), cells, torch.rand(2, 6, 3, 4, dtype=torch.float64)


def test_what_exports_gives_the_same() -> None:
    values, cells, weights = many(4)
    torch.testing.assert_close(sampled_sum(values, cells, weights), deformable_sum(values, cells, weights))


def test_maps_of_samples_and_groups_do_not_mix() -> None:
    values, cells, weights = many(5)
    together = deformable_sum(values, cells, weights)
    for b, g in ((0, 0), (0, 2), (1, 1)):
        alone = naive(values[b : b + 1, :, :, g].permute(0, 3, 1, 2), cells[b : b + 1, :, g], weights[b : b + 1, :, g])
        torch.testing.assert_close(together[b : b + 1, :, g], alone)


def test_maps_of_16_bits_are_read_in_float32() -> None:
    values, cells, weights = (each.float() for each in many(6))
    halved = values.to(torch.bfloat16)
    torch.testing.assert_close(deformable_sum(halved, cells, weights), deformable_sum(halved.float(), cells, weights))


def attention() -> DeformableAttention:
    """One that looks by what its queries are, with a bias of what it reads."""
    torch.manual_seed(3)
    found = DeformableAttention(8, heads=2, points=4, references=2).double()
    for layer in (found.offsets, found.weights):
        torch.nn.init.normal_(layer.weight)
    torch.nn.init.normal_(found.values.bias)
    return found


def test_attention_is_its_parts() -> None:
    looking = attention()
    queries, seen = torch.randn(1, 5, 8, dtype=torch.float64), torch.randn(1, 6, 6, 8, dtype=torch.float64)
    references = 5.0 * torch.rand(1, 5, 2, 2, dtype=torch.float64)
    offsets, weights = looking.looks(queries)
    torch.testing.assert_close(weights.sum(-1), torch.ones(1, 5, 2, dtype=torch.float64))
    values = looking.values(seen).permute(0, 3, 1, 2)
    heads = []
    for head in range(2):
        cells = torch.stack([references[:, :, p // 2] + offsets[:, :, head, p] for p in range(4)], 2)
        heads.append(naive(values[:, 4 * head : 4 * head + 4], cells, weights[:, :, head]))
    torch.testing.assert_close(looking(queries, references, seen), looking.out(torch.cat(heads, -1)))


def test_reading_before_projecting_gives_the_same() -> None:
    """Some places lie beyond the edge, where neither position nor bias may be read."""
    looking = attention()
    queries, seen = torch.randn(2, 9, 8, dtype=torch.float64), torch.randn(2, 6, 7, 8, dtype=torch.float64)
    references = 9.0 * torch.rand(2, 9, 2, 2, dtype=torch.float64) - 2.0
    position = torch.randn(6, 7, 8, dtype=torch.float64)
    known = torch.cat((position, torch.ones(6, 7, 1, dtype=torch.float64)), -1)
    found = looking.read_first(queries, references, seen, known)
    torch.testing.assert_close(found, looking(queries, references, seen + position))


def test_attention_starts_around_its_reference_each_head_its_way() -> None:
    attention = DeformableAttention(8, heads=4, points=2)
    offsets, weights = attention.looks(torch.randn(1, 3, 8))
    expected = torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
    torch.testing.assert_close(offsets[0, 0, :, 0], expected, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(offsets[0, 0, :, 1], 2.0 * expected, atol=1e-6, rtol=0.0)
    assert weights.unique().tolist() == [0.5]


@pytest.mark.parametrize(("channels", "points"), [(9, 4), (8, 3)])
def test_sizes_that_do_not_divide(channels: int, points: int) -> None:
    with pytest.raises(EgolocError, match="deformable attention: expected"):
        DeformableAttention(channels, heads=2, points=points, references=2)
