"""What a map may lack: the made-up worlds' maps are complete, those of users are not.

A network is as sure of itself as the map lets it be, so covariances are calibrated and judged on poorer maps as well.
"""

import math
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from egovm.sample import Sample
from sensors.maps.vector_map import NO_SURFELS, Kind

MapContent = Literal["full", "no-surfels", "lines", "thinned"]
"""All; no surfels; neither surfels nor poles and signs; a share of everything, drawn for each frame."""
CONTENTS: tuple[MapContent, ...] = get_args(MapContent)
SHARE = (0.1, 0.7)
"""Least and largest share of elements and surfels that thinning leaves; its logarithm is uniform."""


def with_content(sample: Sample, content: MapContent, rng: np.random.Generator) -> Sample:
    """The sample with such a map; rng is drawn from for thinning alone."""
    if content == "full":
        return sample
    if content == "no-surfels":
        return replace(sample, surfels=NO_SURFELS)
    if content == "lines":
        lines = sample.elements.chosen(sample.elements.kind < Kind.POLE)
        return replace(sample, elements=lines, surfels=NO_SURFELS)
    share = math.exp(rng.uniform(math.log(SHARE[0]), math.log(SHARE[1])))
    elements = sample.elements.chosen(rng.random(len(sample.elements)) < share)
    return replace(sample, elements=elements, surfels=sample.surfels.chosen(rng.random(len(sample.surfels)) < share))
