"""A sample: one LiDAR frame, where it truly was taken, and the map around: what training and evaluation begin from.

Files hold points by 2 mm and 0.1 ms, and intensities by what a real sensor tells apart: two fifths of floats.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.maps.vector_map import Elements, Surfels
from sensors.whole_file import whole_file

Floats = NDArray[np.float64]

FULL_INTENSITY = 255.0
"""What LiDARs give at most (nuScenes, Argoverse 2, our simulation): the network takes it, and more, as 1."""
_POINT_M, _OFFSET_S = 0.002, 1e-4
"""Steps in files."""
_CODES = ("kind", "style", "colour", "first", "xyz")
_SURFEL = ("p", "z", "normal", "ratios")


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """xyz: (P, 3) float32 m, body axes at the frame's time, as if the vehicle had stood still; intensity: (P,) float32
    0..1; offset_s: (P,) float32 when each was measured, s from the frame's time; T_map_body: (4, 4) the true pose;
    ground_m: height of the ground under the vehicle in body axes, m; elements, surfels: of the map around it.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    offset_s: NDArray[np.float32]
    T_map_body: Floats
    ground_m: float
    elements: Elements
    surfels: Surfels


def save_sample(sample: Sample, path: Path) -> None:
    """Write a file, under its name once it is complete; another process may write the same one."""
    columns = {f"map_{name}": getattr(sample.elements, name) for name in _CODES}
    columns |= {f"surfel_{name}": getattr(sample.surfels, name).astype(np.float32) for name in _SURFEL[2:]}
    columns |= {f"surfel_{name}": getattr(sample.surfels, name) for name in _SURFEL[:2]}
    with whole_file(path) as part, part.open("wb") as file:
        np.savez(
            file,
            xyz=np.rint(sample.xyz / _POINT_M).astype(np.int16),
            intensity=np.rint(sample.intensity * FULL_INTENSITY).astype(np.uint8),
            offset=np.rint(sample.offset_s / _OFFSET_S).astype(np.int16),
            T_map_body=sample.T_map_body,
            ground_m=sample.ground_m,
            **columns,
        )


def load_sample(path: Path) -> Sample:
    """What ``save_sample`` wrote."""
    with np.load(path) as file:
        held = dict(file.items())
    count = len(held["map_kind"])
    names = np.zeros(count, "<U1")
    kind, style, colour, first, xyz = (held[f"map_{name}"] for name in _CODES)
    elements = Elements(kind, style, colour, first, xyz, np.zeros(count, np.int32), names)
    return Sample(
        held["xyz"].astype(np.float32) * np.float32(_POINT_M),
        held["intensity"].astype(np.float32) / np.float32(FULL_INTENSITY),
        held["offset"].astype(np.float32) * np.float32(_OFFSET_S),
        held["T_map_body"],
        float(held["ground_m"]),
        elements,
        Surfels(*(held[f"surfel_{name}"].astype(np.float64) for name in _SURFEL)),
    )
