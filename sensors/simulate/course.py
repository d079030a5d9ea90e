"""Where along its route a drive is at any time, and what surrounds it there: columns that every sensor model reads."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.environment import Environment

Floats = NDArray[np.float64]


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
        start = self.t_ns[0]
        place: Floats = np.interp((t_ns - start).astype(np.float64), (self.t_ns - start).astype(np.float64), self.s)
        return place

    def environment(self, s: Floats) -> NDArray[np.intp]:
        """(N,) index into environments at arc lengths s (N,) m."""
        return self.kind[np.clip(np.searchsorted(self.edges, s, side="right") - 1, 0, len(self.kind) - 1)]

    def map_bias(self, s: Floats) -> Floats:
        """(N, 3) errors of the map at arc lengths s (N,) m, in units of their standard deviations."""
        return np.stack([np.interp(s, self.bias_at, column) for column in self.bias.T], axis=-1)
