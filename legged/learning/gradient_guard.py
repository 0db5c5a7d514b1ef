"""Protection of the networks against NaN gradients in rsl-rl's own update. A hook checks each step of torch's optimiser."""

from typing import Any

import torch


class GradientGuard:
    """Hook that skips each step of an optimiser in which a gradient is NaN or infinite. At every step it reads a number from
    the device.
    """

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        """Register the hook for all later steps of `optimizer`."""
        self._steps, self._left_out = 0, 0
        optimizer.register_step_pre_hook(self._look)

    def _look(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        self._steps += 1
        if gradients and not bool(torch.nn.utils.get_total_norm(gradients) < torch.inf):
            self._left_out += 1
            optimizer.zero_grad(set_to_none=True)  # the optimiser skips parameters without a gradient

    def flush(self) -> float:
        """Return the share of skipped steps since the last flush."""
        share = self._left_out / max(self._steps, 1)
        self._steps, self._left_out = 0, 0
        return share
