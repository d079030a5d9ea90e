"""Where pieces of map appear in a frame's images, at the initial pose and at any other."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovm.batch import SURFEL
from egovm.projection import plane_height
from replay.match_drawing import Pictured, ends_at
from sensors.images import Image
from sensors.maps.vector_map import Kind
from sensors.motion import relative

Floats = NDArray[np.float64]

PARTS = 16
"""A segment is drawn by so many parts: what lies behind the camera or beyond the image is left out by the part."""


class Strokes(NamedTuple):
    """pixels: (N, 2, 2) both ends, column and row, of what is seen; piece: (N,) which piece of map it is of."""

    pixels: Floats
    piece: NDArray[np.int64]


def on_image(pictured: Pictured, image: Image, offset: Floats) -> Strokes:
    """The pieces at an offset (3,) from the initial pose, at the moment of the exposure.

    Segments lie on the plane of the network's ground; poles stand on it. Surfels are left out: there are too many.
    """
    match, bev = pictured.match, pictured.bev
    ends = ends_at(match.pieces, offset)
    pole = match.pieces.type == Kind.POLE
    ends[pole, 1, 2] += match.pieces.height[pole]
    ends[..., 2] += plane_height(bev, bev.ground_m)
    part = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    places = (ends[:, None, 0] + part * (ends[:, None, 1] - ends[:, None, 0])).reshape(-1, 3)
    T = relative(pictured.motion, match.t_ns, image.t_ns) @ match.T_body_lifted
    seen = image.seen(places @ T[:3, :3].T + T[:3, 3])
    pixels, inside = seen.pixels.reshape(-1, PARTS + 1, 2), seen.inside.reshape(-1, PARTS + 1)
    both = inside[:, :-1] & inside[:, 1:] & (match.pieces.type != SURFEL)[:, None]
    strokes = np.stack((pixels[:, :-1], pixels[:, 1:]), axis=2)
    return Strokes(strokes[both], np.nonzero(both)[0])
