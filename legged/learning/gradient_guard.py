"""Keeps NaN out of networks that an optimiser of torch steps by itself, as in rsl-rl's own update."""

from typing import Any

import torch


class GradientGuard:
    """Leaves out the steps of an optimiser in which a gradient is NaN or infinite; reads on the host."""

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        """Every later step of `optimizer` is looked at."""
        self._steps, self._left_out = 0, 0
        optimizer.register_step_pre_hook(self._look)

    def _look(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        self._steps += 1
        if gradients and not bool(torch.nn.utils.get_total_norm(gradients) < torch.inf):
            self._left_out += 1
            optimizer.zero_grad(set_to_none=True)  # a parameter without a gradient is passed over

    def flush(self) -> float:
        """Return the share of steps that were left out since the last flush."""
        share = self._left_out / max(self._steps, 1)
        self._steps, self._left_out = 0, 0
        return share
