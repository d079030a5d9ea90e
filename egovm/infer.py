"""A trained network at work: Matcher, one frame against the map around an initial pose."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from egovm.batch import Batch, Images, MapElements, Points
from egovm.calibration import read_calibration
from egovm.config import NetworkConfig
from egovm.convolutions import deployed, native_precision
from egovm.frame_inputs import FrameInputs, frame_inputs, lifted_axes
from egovm.map_elements import Pieces, padded, pieces_around
from egovm.match import NO_DATA, Match, answer_of, nothing
from egovm.network import EgoVM, Output
from egovm.pose_solver import PoseEstimate
from egovm.weights import load_weights, read_config
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.maps.map_file import MapFile
from sensors.motion import Motion, Standing
from sensors.rotation import check_rigid

Floats = NDArray[np.float64]


class Matcher:
    """Matcher(weights)(frame, vector_map, T_map_init) -> Match. Not for several threads at once."""

    def __init__(self, weights: Path) -> None:
        """weights: a safetensors file with its config beside it, and its calibration where it has one.

        Raises EgolocError where they cannot be read or do not fit each other, and for a network that regresses the pose
        (A6): it states no covariance.
        """
        self.config = read_config(weights)
        if self.config.ablation.solver != "histogram":
            raise EgolocError(f"{weights}: ablation: solver: expected histogram, for regression states no covariance")
        network = EgoVM(self.config)
        load_weights(network, weights)
        self._network: Any = deployed(network, native_precision())
        self._calibration = read_calibration(weights, self.config.solver.lattice)
        self._run(_blank(self.config), None, semantics=False)  # what is compiled at its first use
        self._map_m = 1.5 * self.config.bev.half_m

    def __call__(
        self,
        frame: Frame,
        vector_map: MapFile,
        T_map_init: ArrayLike,
        motion: Motion | None = None,
        *,
        ground_m: float | None = None,
        search: ArrayLike | None = None,
        semantics: bool = False,
    ) -> Match:
        """Match a frame around an initial pose (4, 4) of the body at its t_ns, in the map's frame.

        motion: around the frame; None: the vehicle stood. ground_m: height of the ground under the vehicle in body
        axes, m; None: as its points show. search: (3,) m, m, rad, half of what a prior leaves to be searched, which
        narrows the search only. semantics: the output has the semantic maps as well.
        A search that leaves the truth out finds none of it: give it several sigmas.
        Raises EgolocError for an initial pose that is none or not upright, a search that is not above 0, and images
        that cannot be decoded.
        """
        begin = time.perf_counter()
        T_map_init = np.asarray(T_map_init, np.float64)
        if T_map_init.shape != (4, 4):
            raise EgolocError(f"T_map_init: expected shape (4, 4), got {T_map_init.shape}")
        check_rigid("T_map_init", T_map_init)
        inputs = frame_inputs([frame], self.config, [motion or Standing()], ground_m)
        T_body_lifted = lifted_axes(inputs.lifts[0])
        pieces = self._pieces(vector_map, T_map_init @ T_body_lifted)
        batch = output = None
        if not _holds_data(inputs):
            answer = nothing(NO_DATA, T_map_init, self.config.solver.lattice.levels, len(pieces))
        else:
            batch = Batch(inputs.points, inputs.images, padded([pieces]))
            output = self._run(batch, search, semantics=semantics)
            assert isinstance(output.estimate, PoseEstimate)
            answer = answer_of(output.estimate, T_map_init, T_body_lifted, self._calibration)
            answer = answer._replace(contribution=answer.contribution[: len(pieces)])
        return Match(
            t_ns=frame.t_ns,
            arrival_ns=frame.arrival_ns,
            T_map_init=T_map_init,
            T_body_lifted=T_body_lifted,
            seconds=time.perf_counter() - begin,
            pieces=pieces,
            batch=batch,
            output=output,
            **answer._asdict(),
        )

    def _pieces(self, vector_map: MapFile, T_map_lifted: Floats) -> Pieces:
        x, y = T_map_lifted[:2, 3].tolist()
        elements, surfels = vector_map.around(x, y, self._map_m)
        return pieces_around(elements, surfels, T_map_lifted, self.config, self.config.bev.ground_m)

    @torch.inference_mode()
    def _run(self, batch: Batch, search: ArrayLike | None, *, semantics: bool) -> Output:
        prior = None if search is None else _checked(search)
        output: Output = self._network(batch, prior, semantics=semantics)
        return output


def _checked(search: ArrayLike) -> torch.Tensor:
    """(1, 3) float32."""
    given = np.asarray(search, np.float32)
    if given.shape != (3,) or not (given > 0.0).all():
        raise EgolocError(f"search: expected three numbers above 0 (m, m, rad), got {given.tolist()}")
    return torch.from_numpy(given[None])


def _blank(config: NetworkConfig) -> Batch:
    """A frame with one point, one black image and one piece of map, as far as the network has eyes for them."""
    points = images = None
    if config.lidar is not None:
        points = Points(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1), torch.zeros(1, dtype=torch.int64))
    if config.camera is not None:
        rgb = torch.zeros(1, 1, 3, *config.camera.image_hw)
        places = torch.eye(3)[None, None], torch.eye(4)[None, None]
        images = Images(rgb, *places, torch.ones(1, 1, dtype=torch.bool))
    numbers = torch.zeros(1, 1, 2, 3), torch.zeros(1, 1), torch.zeros(1, 1, 3), torch.zeros(1, 1, 2)
    piece = MapElements(torch.zeros(1, 1, dtype=torch.int64), *numbers, torch.ones(1, 1, dtype=torch.bool))
    return Batch(points, images, piece)


def _holds_data(inputs: FrameInputs) -> bool:
    """Whether there is a point over the BEV plane, or an image. Learned queries alone would make up a pose."""
    points = inputs.points is not None and len(inputs.points.xyz) > 0
    return points or (inputs.images is not None and bool(inputs.images.valid.any()))
