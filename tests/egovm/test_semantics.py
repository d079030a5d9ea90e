"""Semantic logits: Eq. 5 at every level, and where training begins."""

import msgspec
import torch

from egovm.batch import TYPES
from egovm.config import SMALL, BevConfig
from egovm.semantics import PRIOR, SemanticHead

CONFIG = msgspec.structs.replace(SMALL, camera=None, bev=BevConfig(half_m=8.0, channels=(8, 4, 4)))


def test_a_logit_is_the_dot_of_feature_and_embedding_over_the_prior() -> None:
    torch.manual_seed(0)
    head, embeddings = SemanticHead(CONFIG), torch.randn(TYPES, 8)
    features = tuple(torch.randn(2, c, 5 + level, 6 + level) for level, c in enumerate((8, 4, 4)))
    logits = head(features, embeddings)
    assert [tuple(each.shape) for each in logits] == [(2, 7, 5, 6), (2, 7, 6, 7), (2, 7, 7, 8)]
    expected = features[0][1, :, 2, 3] @ embeddings[4] + PRIOR
    assert torch.allclose(logits[0][1, 4, 2, 3], expected, atol=1e-5)
    lower = head.projections[2](embeddings[6])
    assert torch.allclose(logits[2][0, 6, 1, 2], features[2][0, :, 1, 2] @ lower + PRIOR, atol=1e-5)


def test_empty_features_are_one_percent_of_anything() -> None:
    head = SemanticHead(CONFIG)
    logits = head(tuple(torch.zeros(1, c, 4, 4) for c in (8, 4, 4)), torch.randn(TYPES, 8))
    assert all(torch.allclose(each.sigmoid(), torch.tensor(0.01)) for each in logits)


def test_gradients_reach_the_embeddings_from_every_level() -> None:
    torch.manual_seed(1)
    head, embeddings = SemanticHead(CONFIG), torch.randn(TYPES, 8, requires_grad=True)
    features = tuple(torch.randn(1, c, 4, 4) for c in (8, 4, 4))
    for each in head(features, embeddings):
        (gradient,) = torch.autograd.grad(each.sum(), embeddings, retain_graph=True)
        assert gradient[: TYPES - 1].abs().amin(1).min() > 0.0
        assert not gradient[TYPES - 1].any()  # surfels are not drawn
