"""Gradients of PPO's losses and of MLPs in closed form, for updates on a CPU. Autograd takes a third longer there."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

LOG2_E = 1.4426950408889634
HALF_LOG_2PI = 0.9189385332046727


def fits(layers: nn.Sequential) -> bool:
    """Return True if `layers` are linear layers with ELU (Clevert et al., arXiv 1511.07289) with alpha 1 between them."""
    modules = list(layers)
    return all(type(layer) is nn.Linear and layer.bias is not None for layer in modules[::2]) and all(
        type(layer) is nn.ELU and layer.alpha == 1.0 for layer in modules[1::2]
    )


def forward(layers: nn.Sequential, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Return the inputs of each linear layer and the output, each (n, width), and the slopes of the activations (n, width).

    exp2 is the fastest of torch's exponential functions on a CPU, and exp(min(x, 0)) is the slope of ELU at x.
    """
    values, slopes = [x], []
    for layer in layers:
        if isinstance(layer, nn.Linear):
            values.append(torch.addmm(layer.bias, values[-1], layer.weight.t()))
        else:
            slopes.append(values[-1].clamp(max=0.0).mul_(LOG2_E).exp2_())
            values[-1].clamp_(min=0.0).add_(slopes[-1]).sub_(1.0)
    return values, slopes


def backward(layers: nn.Sequential, values: Sequence[Tensor], slopes: Sequence[Tensor], by_output: Tensor) -> list[Tensor]:
    """Return the gradients of weights and biases, in the order of the parameters of `layers`. They are sums over the rows.

    `values` and `slopes` are those of `forward`; `by_output` (n, width) is the gradient by the output.
    """
    gradients: list[Tensor] = []
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    for i in reversed(range(len(linear))):
        gradients = [by_output.t() @ values[i], by_output.sum(dim=0), *gradients]
        if i > 0:
            by_output = (by_output @ linear[i].weight).mul_(slopes[i - 1])
    return gradients


def surrogate_loss(
    mean: Tensor, std: Tensor, actions: Tensor, old_log_prob: Tensor, advantages: Tensor, clip: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return PPO's clipped surrogate loss (n,), its gradient by the `mean` actions (n, D), and the sum over rows of that by
    `std` (D,).
    """
    z = (actions - mean) / std
    log_prob = -0.5 * z.square().sum(dim=1) - std.log().sum() - mean.shape[1] * HALF_LOG_2PI
    ratio = (log_prob - old_log_prob).exp()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    plain, limited = -advantages * ratio, -advantages * clipped
    # The larger loss counts. Its gradient is 0 where it is the limited one and the ratio is clipped.
    active = torch.where((ratio == clipped) | (plain > limited) | ratio.isnan(), plain, 0.0).unsqueeze(1)
    return torch.maximum(plain, limited), active * z / std, (active * (z.square() - 1.0) / std).sum(dim=0)


def value_loss(values: Tensor, returns: Tensor, old_values: Tensor, clip: float | None) -> tuple[Tensor, Tensor]:
    """Return the square errors (n,) of `values` (n,), and their gradient (n,). With a `clip` the larger of two errors counts:
    that of the value, and that of the value after its difference from the old one is clipped.
    """
    error = values - returns
    loss, gradient = error.square(), 2.0 * error
    if clip is None:
        return loss, gradient
    moved = values - old_values
    near = (old_values + moved.clamp(-clip, clip) - returns).square()
    return torch.maximum(loss, near), torch.where((moved.abs() <= clip) | (loss > near) | moved.isnan(), gradient, 0.0)
