"""Elements of a map from lists of vertices."""

from collections.abc import Sequence

import numpy as np

from sensors.maps.vector_map import Elements, Kind, Style

Vertices = Sequence[Sequence[float]] | np.ndarray


def made(*drawn: tuple[Kind, Vertices] | tuple[Kind, Vertices, Style]) -> Elements:
    """Elements of kinds and vertices (n, 2) or (n, 3), and styles."""
    vertices = [np.atleast_2d(np.asarray(each[1], np.float64)) for each in drawn]
    xyz = [v if v.shape[1] == 3 else np.column_stack((v, np.zeros(len(v)))) for v in vertices]
    count = len(drawn)
    style = [each[2] if len(each) == 3 else Style.UNKNOWN for each in drawn]
    return Elements(
        np.array([each[0] for each in drawn], np.int8),
        np.array(style, np.int8),
        np.zeros(count, np.int8),
        np.concatenate(([0], np.cumsum([len(v) for v in xyz]))).astype(np.int64),
        np.concatenate(xyz) if xyz else np.empty((0, 3)),
        np.zeros(count, np.int32),
        np.array([f"e{i}" for i in range(count)], np.str_),
    )
