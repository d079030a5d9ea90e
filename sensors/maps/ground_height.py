"""Ground height of an Argoverse 2 log: a raster beside its map, and the similarity that leads into it."""

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats
from sensors.maps.json_text import read_json


class _Sim2(msgspec.Struct):
    """Pixel of a city point: s * (R p + t). Source: av2-api, ``av2.geometry.sim2``."""

    R: Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]
    t: Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)]
    s: float


def ground_height(folder: Path, xy: Floats) -> Floats:
    """(N,) heights, m, of city points (N, 2); NaN off the raster, and everywhere where the folder holds none.

    The file's numbers have half precision: steps of 6 cm at 64 m and more. Raises EgolocError for a file that is no
    such raster.
    """
    rasters = sorted(folder.glob("*_ground_height_surface____*.npy"))
    similarities = sorted(folder.glob("*___img_Sim2_city.json"))
    if len(rasters) != 1 or len(similarities) != 1:
        return np.full(len(xy), np.nan)
    raster, to_image = _raster(rasters[0]), read_json(similarities[0], _Sim2)
    pixel = to_image.s * (xy @ np.reshape(to_image.R, (2, 2)).T + to_image.t)
    inside = ((pixel >= 0) & (pixel < raster.shape[::-1])).all(axis=1)
    column, row = np.where(inside[:, None], pixel, 0.0).astype(np.int64).T
    return np.where(inside, raster[row, column], np.nan)


def _raster(path: Path) -> Floats:
    try:
        raster = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise EgolocError(f"{path}: expected a numpy raster of heights: {error}") from error
    if raster.ndim != 2 or raster.dtype.kind != "f" or not raster.size or np.isinf(raster).any():
        raise EgolocError(f"{path}: expected heights (rows, columns), got {raster.dtype} {raster.shape}")
    return np.asarray(raster, np.float64)
