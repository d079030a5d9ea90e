"""What is drawn of a match, in a picture as in a recording: levels, histograms, and its pieces of map before and after.

Places are in lifted axes at the initial pose unless said otherwise: x forward, y left, m. What the sensors saw stays
where it is; the map moves, from where the initial pose puts it to where the estimate does.
"""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.batch import SURFEL
from egovm.config import BevConfig
from egovm.lattice import seen_from
from egovm.map_elements import Pieces
from egovm.match import Match
from sensors.clock import NS_PER_S
from sensors.frames import Frame
from sensors.maps.vector_map import Kind
from sensors.motion import Motion, Standing

Floats = NDArray[np.float64]

COLOURS: Mapping[int, str] = {
    Kind.LANE_LINE: "#56b4e9",
    Kind.ROAD_BOUNDARY: "#e69f00",
    Kind.STOP_LINE: "#cc79a7",
    Kind.CROSSING: "#00b583",
    Kind.MARKING: "#f0e442",
    Kind.POLE: "#ffffff",
    Kind.SIGN: "#e8612c",
    SURFEL: "#8c939c",
}
"""By type of a piece, before a dark ground; told apart by those who are colour-blind as well (Okabe and Ito)."""
AGAINST, NEUTRAL, FOR = "#ff9d2e", "#7d858f", "#3fb4ff"
"""Of what a piece adds to the score: less than nothing, nothing, much."""
CLOSE_M = 20.0
"""The map before and after is shown this far around the vehicle: farther, an offset is too small to be seen."""


class Pictured(NamedTuple):
    """A match, and what is known beside it.

    bev: of the network's config; truth: (3,) map x, y m and yaw rad of the body at the match's time; frame: what was
    matched, for its images; motion: of the vehicle around it.
    """

    match: Match
    bev: BevConfig
    truth: Floats | None = None
    frame: Frame | None = None
    motion: Motion = Standing()


def kind_name(kind: int) -> str:
    """As it stands in a legend."""
    return "surfel" if kind == SURFEL else Kind(kind).name.lower().replace("_", " ")


def offset_of(match: Match, pose: Floats) -> Floats:
    """(3,) a pose (map x, y m, yaw rad) as an offset on the body side of the initial one: the inverse of what the
    matcher does, exactly, under roll and pitch as well."""
    R = match.T_map_init[:2, :2]
    x, y = np.linalg.solve(R, pose[:2] - match.T_map_init[:2, 3])
    cosine, sine = np.linalg.solve(R, (np.cos(pose[2]), np.sin(pose[2])))
    return np.array((x, y, np.arctan2(sine, cosine)))


def estimated_offset(match: Match) -> Floats:
    """(3,) of the pose that was found; 0 where none was."""
    return offset_of(match, match.pose)


def ends_at(pieces: Pieces, offset: Floats) -> Floats:
    """(K, 2, 3) ends of the pieces in lifted axes at an offset (3,) from the initial pose, z above the plane."""
    ends = torch.from_numpy(pieces.ends.astype(np.float64))
    xy: Floats = seen_from(torch.from_numpy(offset), ends[..., :2]).numpy()
    return np.concatenate((xy, pieces.ends[..., 2:]), axis=-1)


def points_of(match: Match) -> Floats | None:
    """(P, 4) x, y, z m and intensity 0..1 of what the network saw; None without LiDAR."""
    points = None if match.batch is None else match.batch.points
    return None if points is None else np.column_stack((array(points.xyz), array(points.intensity)))


def rgb(colour: str) -> tuple[int, int, int]:
    """0..255 of #rrggbb."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def sigmas(match: Match) -> Floats:
    """(3,) that are stated: longitudinal and lateral at the pose that was found, m, and yaw, rad."""
    if not match.found:
        return np.full(3, np.inf)
    c, s = np.cos(match.pose[2]), np.sin(match.pose[2])
    axes = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    found: Floats = np.sqrt(np.diagonal(axes.T @ match.cov @ axes))
    return found


def error_of(match: Match, truth: Floats) -> Floats:
    """(3,) forward and left, m, in the axes of the true heading, and yaw, rad: of the pose that was found."""
    c, s = np.cos(truth[2]), np.sin(truth[2])
    (x, y), yaw = match.pose[:2] - truth[:2], match.pose[2] - truth[2]
    return np.array((c * x + s * y, c * y - s * x, np.arctan2(np.sin(yaw), np.cos(yaw))))


def array(values: Tensor) -> Floats:
    """In float64, for drawing."""
    return values.detach().double().cpu().numpy()


def title(pictured: Pictured) -> tuple[str, str]:
    """What was found, in two lines."""
    match = pictured.match
    moment = datetime.fromtimestamp(match.t_ns / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    used = "/".join(map(str, match.landmarks))
    left_out = f", {match.left_out} more left out" if match.left_out else ""
    rest = f"landmarks {used} of {len(match.pieces)}{left_out}; {1e3 * match.seconds:.0f} ms"
    if not match.found:
        return f"{moment} UTC: no fix, {match.reason}", rest
    x, y, yaw = estimated_offset(match)
    lon, lat, turn = sigmas(match)
    moved = f"offset {x:+.3f} m forward, {y:+.3f} m left, {np.degrees(yaw):+.3f}°"
    stated = f"sigma {lon:.3f} m lon, {lat:.3f} m lat, {np.degrees(turn):.3f}°"
    if pictured.truth is not None:
        forward, left, wrong = error_of(match, pictured.truth)
        stated += f";  error {forward:+.3f} m lon, {left:+.3f} m lat, {np.degrees(wrong):+.3f}°"
    return f"{moment} UTC:  {moved}", f"{stated};  {rest}"
