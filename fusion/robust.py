"""Robust kernels: a measurement that lies far out, within its gate, counts less.

M-estimation of the update by iterated reweighting (Huber 1981, ch. 7; Zhang 1997): minimize dx' P^-1 dx plus
twice rho(|R^-1/2 (z - H dx)|), where the weight psi(r) / r of the residual r of one solution divides R in the next.
"""

import math

from fusion.gating import innovate, whiten
from fusion.state import Floats
from sensors.kernel import kernel

ITERATIONS = 2


@kernel()
def weight_of(kind: int, r: float, sigmas: float) -> float:
    """Weight of a residual of r standard deviations, at most 1: sigmas / r (1 Huber) or 1 / (1 + (r / sigmas)^2)."""
    if kind == 1:
        return sigmas / r if r > sigmas else 1.0
    return 1.0 / (1.0 + (r / sigmas) ** 2)


@kernel()
def reweigh(
    P: Floats, H: Floats, W: Floats, dof: int, R: Floats, L: Floats, white: Floats, z: Floats, k: int, kind: int,
    sigmas: float, x: Floats,
) -> float:  # fmt: skip
    """Divide R (3, 3) by the measurement's weight and whiten its innovation z[k] (M, 3) again; returns the weight.

    After ``innovate`` and ``whiten``: W, L and white (3,) are theirs and are made anew. The residual that counts is the
    one which the update leaves, R S^-1 z, in standard deviations, root mean square over its dof components: a jump that
    P explains weighs full. x (3,): scratch.
    """
    weight = 1.0
    for _ in range(ITERATIONS):
        for i in range(dof - 1, -1, -1):  # x = S^-1 z = L'^-1 white
            x[i] = white[i]
            for j in range(i + 1, dof):
                x[i] -= L[j, i] * x[j]
            x[i] /= L[i, i]
        total = 0.0
        for i in range(dof):
            for j in range(dof):
                total += x[i] * R[i, j] * x[j]
        new = weight_of(kind, math.sqrt(total / weight / dof), sigmas)
        for i in range(dof):
            white[i] = z[k, i]
            for j in range(dof):
                R[i, j] *= weight / new
        weight = new
        innovate(P, H, W, dof, R, L)
        whiten(dof, white, L)
    return weight
