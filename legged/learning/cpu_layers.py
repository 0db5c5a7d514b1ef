"""Layers for training on a CPU: an ELU that is faster than torch's, and a linear layer whose gradient does not depend on the
number of threads.
"""

from typing import Any

import torch
from torch import Tensor

LOG2_E = 1.4426950408889634
PARTS = 8
"""Number of parts into which a batch is split. Each part is summed up by a single thread."""


class ExponentialUnit(torch.autograd.Function):
    """ELU with alpha 1 (Clevert et al., arXiv 1511.07289): x if x is positive, else exp(x) - 1.

    On a CPU torch's ELU takes a quarter of an update's time. This class takes half as long. It uses exp2, which is by
    far the fastest of torch's exponential functions. No branch is needed, because ELU is the larger of x and
    min(exp(x), 1) - 1.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Return the activations of `x`."""
        y = x.clamp(max=0.0).mul_(LOG2_E).exp2_().sub_(1.0)
        torch.maximum(x, y, out=y)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        """Return the gradient with respect to x, computed from the activations."""
        (y,) = ctx.saved_tensors
        return torch.ops.aten.elu_backward(gradients[0], 1.0, 1.0, 1.0, True, y)


class Affine(torch.autograd.Function):
    """Linear layer for a batch x (N, I), with gradients that are bit-identical for any number of threads.

    The gradient of the weights is a sum over N. torch's library splits that sum among its threads, so the rounding depends on
    the number of threads. UpdateThreads changes this number. This layer always splits the sum into `PARTS` parts.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return x weight^T + bias (N, O)."""
        ctx.save_for_backward(x, weight)
        return torch.nn.functional.linear(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Return the gradients with respect to x (N, I), weight (O, I) and bias (O,)."""
        x, weight = ctx.saved_tensors
        y = gradients[0]
        rows = len(x) // PARTS
        of_x = y @ weight if ctx.needs_input_grad[0] else None
        ours, theirs = (factor[: PARTS * rows].reshape(PARTS, rows, factor.shape[1]) for factor in (y, x))
        each = torch.bmm(ours.mT, theirs)
        of_weight = each.sum(dim=0).addmm_(y[PARTS * rows :].t(), x[PARTS * rows :])
        return of_x, of_weight, y.sum(dim=0)


def apply_layers(layers: torch.nn.Sequential, x: Tensor) -> Tensor:
    """Apply `layers` to a batch x (N, I) on a CPU."""
    for layer in layers:
        if type(layer) is torch.nn.ELU and layer.alpha == 1.0:
            x = ExponentialUnit.apply(x)
        elif type(layer) is torch.nn.Linear and layer.bias is not None and x.ndim == 2:
            x = Affine.apply(x, layer.weight, layer.bias)
        else:
            x = layer(x)
    return x
