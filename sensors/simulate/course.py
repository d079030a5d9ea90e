"""Where along its route a drive is at any time, and what surrounds it there: columns that every sensor model reads."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.environment import Environment
from sensors.simulate.fields import Waves

Floats = NDArray[np.float64]

BIAS_STEP_M = 20.0
"""Spacing of the map's errors along a route, m: a fifteenth of the distance over which they change."""


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Arc length over time, environments and map errors over arc length.

    t_ns: (K,) int64; s: (K,) m, never decreasing; names: (E,) scene tags of environments (E,); edges: (M + 1,) m, where
    stretches begin and end; kind: (M,) index into environments; bias_at: (B,) m; bias: (B, 3) errors of the map along,
    left and in yaw, each of unit variance over a network, the same whenever the same road is driven.
    """

    t_ns: NDArray[np.int64]
    s: Floats
    names: tuple[str, ...]
    environments: tuple[Environment, ...]
    edges: Floats
    kind: NDArray[np.intp]
    bias_at: Floats
    bias: Floats

    def place(self, t_ns: NDArray[np.int64]) -> Floats:
        """(N,) m of arc length at t_ns (N,)."""
        if not len(t_ns):
            return np.empty(0)
        # only the rows around the times asked for: a piece of a long drive costs no more than one of a short drive
        first = max(int(np.searchsorted(self.t_ns, t_ns.min(), side="right")) - 1, 0)
        rows = slice(first, int(np.searchsorted(self.t_ns, t_ns.max(), side="left")) + 1)
        start = self.t_ns[0]
        known = (self.t_ns[rows] - start).astype(np.float64)
        place: Floats = np.interp((t_ns - start).astype(np.float64), known, self.s[rows])
        return place

    def environment(self, s: Floats) -> NDArray[np.intp]:
        """(N,) index into environments at arc lengths s (N,) m."""
        return self.kind[np.clip(np.searchsorted(self.edges, s, side="right") - 1, 0, len(self.kind) - 1)]

    def map_bias(self, s: Floats) -> Floats:
        """(N, 3) errors of the map at arc lengths s (N,) m, in units of their standard deviations."""
        row = np.clip(np.searchsorted(self.bias_at, s, side="right") - 1, 0, max(len(self.bias_at) - 2, 0))
        after = np.minimum(row + 1, len(self.bias_at) - 1)
        into = np.clip((s - self.bias_at[row]) / np.maximum(self.bias_at[after] - self.bias_at[row], 1e-9), 0.0, 1.0)
        return self.bias[row] + into[:, None] * (self.bias[after] - self.bias[row])


def bias_along(fields: tuple[Waves, Waves, Waves], xy: Floats) -> Floats:
    """(B, 3) errors of the map at places xy (B, 2) m."""
    return np.stack([field.at(xy) for field in fields], axis=-1)
