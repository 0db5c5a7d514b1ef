"""Recorder of the KL divergence that rsl-rl's own update computes for its learning rate but does not log."""

from typing import Any

import torch
from torch import Tensor


class KLMeter:
    """Wrapper around a policy's `get_kl_divergence` that records the results. Callers still get these results."""

    def __init__(self, policy: Any) -> None:
        self._means: list[Tensor] = []
        ask = policy.get_kl_divergence

        def listened(*args: Any, **kwargs: Any) -> Tensor:
            found = ask(*args, **kwargs)
            self._means.append(found.mean())
            return found

        policy.get_kl_divergence = listened

    @torch.inference_mode()
    def flush(self) -> float | None:
        """Return the mean divergence since the last flush, or None if rsl-rl has computed no divergence, as with a fixed
        learning rate.
        """
        means, self._means = self._means, []
        return float(torch.stack(means).mean()) if means else None
