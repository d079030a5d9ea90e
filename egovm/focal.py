"""The focal loss of every cell in few passes: the finest level has six million, and autograd would keep ten copies."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus


class FocalByType(torch.autograd.Function):
    """Sum (types,) of (1 - p)^gamma * -log p over frames and cells, p: what is said of what is true there.

    With s the logit against the truth, 1 - p = sigmoid(s) = q and -log p = softplus(s); the slope by s is
    q^gamma (gamma (1 - q) softplus(s) + q). Only that is kept for the gradient.
    """

    @staticmethod
    def forward(ctx: Any, logits: Tensor, drawn: Tensor, gamma: float) -> Tensor:
        """logits, drawn: (B, types, H, W)."""
        against = torch.where(drawn, -logits, logits)
        entropy, missed = softplus(against), torch.sigmoid(against)
        weight = missed**gamma
        found = (weight * entropy).sum((0, 2, 3))
        if ctx.needs_input_grad[0]:
            slope = entropy.mul_(1.0 - missed).mul_(gamma).add_(missed).mul_(weight)
            ctx.save_for_backward(torch.where(drawn, -slope, slope))
        return found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """By the logits."""
        (slope,) = ctx.saved_tensors
        return slope * gradients[0][:, None, None], None, None
