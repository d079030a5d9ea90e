"""Poorer maps: what they lack, and that all else of a sample stays."""

import numpy as np
import pytest

from egovm.made_samples import made_sample
from egovm.map_contents import CONTENTS, SHARE, MapContent, with_content
from egovm.sample import Sample
from sensors.maps.vector_map import Kind
from tests.egovm.made_training import RECIPE


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made_sample(RECIPE, "train", 2)


def poorer(sample: Sample, content: MapContent, seed: int = 0) -> Sample:
    return with_content(sample, content, np.random.default_rng(seed))


@pytest.mark.parametrize("content", CONTENTS)
def test_the_map_alone_changes(sample: Sample, content: MapContent) -> None:
    found = poorer(sample, content)
    for name in ("xyz", "intensity", "offset_s", "T_map_body", "ground_m"):
        assert getattr(found, name) is getattr(sample, name)


def test_what_is_lacking(sample: Sample) -> None:
    assert {int(kind) for kind in sample.elements.kind} >= {Kind.LANE_LINE, Kind.POLE}
    assert poorer(sample, "full") is sample
    assert poorer(sample, "no-surfels").elements is sample.elements
    assert len(poorer(sample, "no-surfels").surfels) == len(poorer(sample, "lines").surfels) == 0
    lines = poorer(sample, "lines").elements
    assert len(lines) == (sample.elements.kind < Kind.POLE).sum()
    assert lines.kind.max() < Kind.POLE


def test_thinning_leaves_a_share_of_all_that_is_drawn_for_the_frame(sample: Sample) -> None:
    shares = np.array(
        [
            (len(found.elements) + len(found.surfels)) / (len(sample.elements) + len(sample.surfels))
            for found in (poorer(sample, "thinned", seed) for seed in range(100))
        ]
    )
    assert shares.min() > 0.4 * SHARE[0]
    assert shares.max() < 1.3 * SHARE[1]
    assert np.median(shares) == pytest.approx(np.sqrt(SHARE[0] * SHARE[1]), rel=0.3)
    a, b = (poorer(sample, "thinned", 3) for _ in range(2))
    assert np.array_equal(a.elements.xyz, b.elements.xyz)
    assert np.array_equal(a.surfels.p, b.surfels.p)
