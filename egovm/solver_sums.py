"""Sums over all points of their dots at every candidate, where no gradients are wanted: one pass over the patches.

In torch each yaw's part of every patch is gathered first, 20 MB of them at 500 elements, which takes four times as long
as all dots together.
"""

import torch
from torch import Tensor

from egovm.solver_kernels import add_lattice_sums


def can_sum(dots: Tensor, local: Tensor) -> bool:
    """By the kernel: on the CPU, not in an export, and nothing asks for gradients."""
    if torch.compiler.is_exporting() or torch.onnx.is_in_onnx_export():
        return False
    wanted = torch.is_grad_enabled() and (dots.requires_grad or local.requires_grad)
    return dots.device.type == "cpu" and not wanted


@torch.library.custom_op("egovm::lattice_sums", mutates_args=())
def lattice_sums(dots: Tensor, local: Tensor, times: Tensor, steps: int) -> Tensor:
    """(B, yaw, steps, steps) sums over N points, translations rising.

    dots: (B, N, G, S, S); local: (B, N, yaw, 2) row and column in the patch of a point under each yaw, for the largest
    translation; times: (B, N) how often each point counts.
    """
    samples, _, around, _ = local.shape
    size = dots.shape[-1]
    found = dots.new_zeros((samples, around, steps * size))
    for group in dots.unbind(2):
        arrays = [array.detach().contiguous().numpy() for array in (group.flatten(2), local, times)]
        add_lattice_sums(*arrays, size, found.numpy())
    return torch.unflatten(found, -1, (steps, size))[..., :steps].flip(-2, -1)


@lattice_sums.register_fake
def _(dots: Tensor, local: Tensor, times: Tensor, steps: int) -> Tensor:
    return dots.new_empty((*local.shape[:1], local.shape[2], steps, steps))
