"""Places in body axes to pixels of the images, and to cells of their features."""

import torch
from torch import Tensor

from egovm.batch import Images

NEAREST_M = 0.1
"""Nothing closer ahead of a camera than this is seen."""


def project(places: Tensor, images: Images) -> tuple[Tensor, Tensor]:
    """Where places (Q, 3) m in body axes appear, by the pinhole model.

    Pixels (B, N, Q, 2), row before column, a whole number being the middle of a pixel; and whether they are in the
    image (B, N, Q): ahead of the camera, within the image, and the image is valid. Float32 also under autocast.
    """
    height, width = images.rgb.shape[-2:]
    with torch.autocast(places.device.type, enabled=False):
        P = images.K.float() @ images.T_camera_body[..., :3, :].float()
        seen = P[..., :3] @ places.float().T + P[..., 3:]
    depth = seen[..., 2, :]
    column, row = seen[..., :2, :].div(depth.clamp(min=NEAREST_M)[..., None, :]).unbind(-2)
    inside = (row > -0.5) & (row < height - 0.5) & (column > -0.5) & (column < width - 0.5)
    return torch.stack((row, column), -1), inside & (depth > NEAREST_M) & images.valid[..., None]


def feature_cells(pixels: Tensor, stride: int) -> Tensor:
    """Rows and columns in cells of features, of pixels: the middle of cell 0 is that of its stride x stride pixels."""
    return (pixels + 0.5) / stride - 0.5
