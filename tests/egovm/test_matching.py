"""Map queries and the decoder: what padding, order and ablations do, and gradients."""

from typing import Any

import msgspec
import pytest
import torch
from torch import Tensor

from egovm.batch import SURFEL, TYPES, MapElements
from egovm.config import SMALL, Ablation, BevConfig, MatchingConfig, NetworkConfig
from egovm.map_encoder import MapEncoder, SemanticEmbeddings
from egovm.matching import ElementAttention, Matching, sine_positions
from sensors.errors import EgolocError
from sensors.maps.vector_map import Kind

torch.set_num_threads(1)

TINY = msgspec.structs.replace(
    SMALL,
    camera=None,
    bev=BevConfig(half_m=8.0, channels=(16, 8, 4)),
    matching=MatchingConfig(layers=2, heads=2, points=2, hidden=16),
)


def elements(frames: int, count: int, seed: int = 0) -> MapElements:
    """Random pieces of all types, all valid."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2.0 * torch.rand(frames, count, *shape, generator=draw) - 1.0

    type_ = torch.arange(frames * count).reshape(frames, count) % TYPES
    normal = torch.nn.functional.normalize(uniform(3), dim=-1)
    valid = torch.ones(frames, count, dtype=torch.bool)
    return MapElements(type_, 6.0 * uniform(2, 3), 5.0 * uniform().abs(), normal, 0.1 * uniform(2).abs(), valid)


def bev(frames: int, seed: int = 1) -> Tensor:
    return torch.randn(frames, 16, 32, 32, generator=torch.Generator().manual_seed(seed))


def made(config: NetworkConfig) -> Matching:
    torch.manual_seed(3)
    return Matching(config).eval()


def changed(given: MapElements, **columns: Tensor) -> MapElements:
    return MapElements(**{name: columns.get(name, getattr(given, name)) for name in MapElements.__slots__})


@pytest.mark.parametrize("decoder", [True, False])
def test_embeddings_of_each_level(decoder: bool) -> None:
    matching = made(msgspec.structs.replace(TINY, ablation=Ablation(decoder=decoder)))
    given = elements(2, 9)
    found = matching(given, bev(2))
    assert [tuple(each.shape) for each in found] == [(2, 9, 16), (2, 9, 8), (2, 9, 4)]
    other = matching(given, bev(2, seed=5))
    assert torch.equal(found[0], other[0]) != decoder  # A2 does not look at the BEV
    alone = matching(changed(given, valid=given.valid & (torch.arange(9) == 0)), bev(2))
    assert torch.allclose(found[2][:, 0], alone[2][:, 0]) != decoder  # nor elements at each other


def test_padding_says_nothing_and_gets_nothing() -> None:
    matching, given = made(TINY), elements(1, 9)
    valid = torch.arange(9)[None] < 6
    found = matching(changed(given, valid=valid), bev(1))
    junk = torch.where(valid[..., None, None], given.ends, torch.full_like(given.ends, 77.0))
    again = matching(changed(given, valid=valid, ends=junk), bev(1))
    short = MapElements(**{name: getattr(given, name)[:, :6] for name in MapElements.__slots__})
    for a, b, c in zip(found, again, matching(short, bev(1)), strict=True):
        assert torch.equal(a, b)
        assert torch.allclose(a[:, :6], c, atol=1e-6)
        assert not a[:, 6:].any()
        assert a[:, :6].any()


def test_the_order_of_elements_does_not_matter() -> None:
    matching, given = made(TINY), elements(1, 12)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(2))
    shuffled = MapElements(**{name: getattr(given, name)[:, order] for name in MapElements.__slots__})
    for a, b in zip(matching(given, bev(1)), matching(shuffled, bev(1)), strict=True):
        assert torch.allclose(a[:, order], b, atol=1e-5)


@pytest.mark.parametrize("valid", [0, 1])
def test_no_element_and_one_give_finite_numbers_and_gradients(valid: int) -> None:
    matching, given, seen = made(TINY), elements(2, 4), bev(2).requires_grad_()
    kept = changed(given, valid=torch.arange(4) < torch.tensor([[valid], [4]]))
    found = matching(kept, seen)
    assert all(torch.isfinite(each).all() for each in found)
    torch.stack([each.square().sum() for each in found]).sum().backward()
    assert seen.grad is not None
    assert torch.isfinite(seen.grad).all()
    assert all(torch.isfinite(p.grad).all() for p in matching.parameters() if p.grad is not None)


def test_elements_outside_the_bev_read_nothing_of_it() -> None:
    matching, given = made(TINY), elements(1, 4)
    far = changed(given, ends=given.ends + 500.0)
    a, b = matching(far, bev(1)), matching(far, bev(1, seed=9))
    assert all(torch.isfinite(each).all() for each in a)
    assert torch.equal(a[0], b[0])


@pytest.mark.parametrize("sampled", ["ends", "middle", 3])
def test_an_element_looks_at_the_bev_where_it_lies(sampled: Any) -> None:
    """Offsets are a cell or two at the start: what is changed farther away does not matter."""
    config = msgspec.structs.replace(
        TINY, matching=MatchingConfig(layers=1, heads=2, points=2, hidden=16, sampled=sampled)
    )
    matching = made(config)
    given = changed(elements(1, 1), ends=torch.tensor([[[[4.0, -5.0, 0.0], [4.5, -5.0, 0.0]]]]))
    seen = bev(1)
    near, elsewhere = seen.clone(), seen.clone()
    near[:, :, 23:27, 4:8] += 1.0  # row (4 + 8) / 0.5, column (-5 + 8) / 0.5
    elsewhere[:, :, 4:8, 23:27] += 1.0
    found = matching(given, seen)[0]
    assert torch.equal(found, matching(given, elsewhere)[0])
    assert not torch.allclose(found, matching(given, near)[0], atol=1e-3)


def test_each_kind_is_encoded_by_its_own_numbers() -> None:
    torch.manual_seed(0)
    encoder, embeddings = MapEncoder(TINY), SemanticEmbeddings(16, learned=True)()
    given = elements(1, 16)
    base = encoder(given, embeddings)
    type_ = given.type[0]
    moved = {
        "height": given.height + 1.0,
        "normal": -given.normal,
        "ratios": given.ratios + 0.1,
        "ends": given.ends + torch.tensor([1.0, -1.0])[:, None] * torch.tensor([1.0, 0.0, 0.0]),  # the middle stays
    }
    by = {
        name: (encoder(changed(given, **{name: value}), embeddings) != base).any(-1)[0] for name, value in moved.items()
    }
    stands = (type_ == Kind.POLE) | (type_ == Kind.SIGN)
    assert torch.equal(by["height"], stands)
    assert torch.equal(by["normal"], type_ == SURFEL)
    assert torch.equal(by["ratios"], type_ == SURFEL)
    assert torch.equal(by["ends"], ~stands & (type_ != SURFEL))


def test_the_query_is_position_plus_type() -> None:
    torch.manual_seed(0)
    encoder, embeddings = MapEncoder(TINY), SemanticEmbeddings(16, learned=True)()
    line, boundary = torch.zeros(1, 1, dtype=torch.int64), torch.ones(1, 1, dtype=torch.int64)
    one = elements(1, 1)
    apart = encoder(changed(one, type=boundary), embeddings) - encoder(changed(one, type=line), embeddings)
    assert torch.allclose(apart[0, 0], embeddings[1] - embeddings[0], atol=1e-6)


def test_a4_encodes_the_number_of_the_type_instead() -> None:
    matching = made(msgspec.structs.replace(TINY, ablation=Ablation(semantic_embedding=False)))
    assert matching.semantic.learned is None
    embeddings = matching.semantic()
    assert embeddings.shape == (TYPES, 16)
    assert torch.pdist(embeddings).min() > 1e-3
    assert [tuple(each.shape) for each in matching(elements(1, 3), bev(1))] == [(1, 3, 16), (1, 3, 8), (1, 3, 4)]


def test_self_attention_is_that_of_the_paper() -> None:
    """Against softmax(q k / sqrt(d)) v written out, the padding masked."""
    torch.manual_seed(1)
    attention, queries = ElementAttention(8, 2), torch.randn(1, 5, 8)
    valid = torch.tensor([[True, True, False, True, False]])
    asked, keys, values = attention.given(queries)[0].unflatten(-1, (3, 2, 4)).unbind(1)
    scores = torch.einsum("ihc,jhc->hij", asked, keys) / 2.0
    scores[:, :, ~valid[0]] = -torch.inf
    expected = attention.out(torch.einsum("hij,jhc->ihc", scores.softmax(-1), values).flatten(1))
    assert torch.allclose(attention(queries, valid)[0], expected, atol=1e-6)


def test_gradients_of_the_decoder_are_those_of_finite_differences() -> None:
    torch.manual_seed(2)
    matching, given = Matching(TINY).double(), elements(1, 3)
    given = changed(given, ends=given.ends.double(), height=given.height.double(), normal=given.normal.double())
    given = changed(given, ratios=given.ratios.double(), valid=torch.tensor([[True, True, False]]))
    weight = torch.randn(16, generator=torch.Generator().manual_seed(0)).double()

    def scalar(seen: Tensor, embeddings: Tensor) -> Tensor:
        queries = matching.encoder(given, embeddings)
        cells = matching.grid.cells_from_m(given.ends[..., :2])
        return matching.layers[0](queries, given.valid, cells, seen, matching.position[:6, :6]) @ weight

    seen = bev(1)[:, :, :6, :6].permute(0, 2, 3, 1).double().requires_grad_()
    embeddings = matching.semantic().detach().requires_grad_()
    assert torch.autograd.gradcheck(scalar, (seen, embeddings), fast_mode=True)


def test_positions_tell_all_cells_apart() -> None:
    position = sine_positions(32, 16)
    assert position.shape == (16, 32, 32)
    assert torch.pdist(position.flatten(1).T).min() > 0.05
    assert torch.equal(position, sine_positions(32, 16))


def test_channels_that_no_pairs_of_sines_fill_are_told() -> None:
    with pytest.raises(EgolocError, match="channels: expected the first to be divisible by 4, got 6"):
        sine_positions(8, 6)


def test_it_exports_with_the_same_outputs() -> None:
    matching, given = made(TINY), elements(1, 9)
    columns = tuple(getattr(given, name) for name in MapElements.__slots__)

    class Flat(torch.nn.Module):
        """Tensors in place of the record."""

        def __init__(self) -> None:
            super().__init__()
            self.matching = matching

        def forward(self, seen: Tensor, *columns: Tensor) -> tuple[Tensor, ...]:
            found: tuple[Tensor, ...] = self.matching(MapElements(*columns), seen)
            return found

    program = torch.export.export(Flat(), (bev(1), *columns)).module()
    for a, b in zip(program(bev(1), *columns), matching(given, bev(1)), strict=True):
        assert torch.allclose(a, b, atol=1e-6)
