"""Reward terms: scaled, summed, clipped and recorded per episode."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from legged.graph.step_graph import calling
from legged.math import masked_set_
from legged.mdp.kernels import Kernels
from legged.mdp.nan_guard import LARGEST


class Rewards:
    """Reward of a step: the sum of scale * dt * term. If the sum is clipped at zero, the term `termination` is added after
    the clip, as in legged_gym.
    """

    STATE = ("sums",)

    def __init__(
        self,
        functions: Mapping[str, Callable[[], Tensor]],
        scales: Mapping[str, float],
        dt: float,
        only_positive: bool,
        total: Tensor,
        kernels: Kernels | None = None,
    ) -> None:
        """Build the sum of the terms in `functions`, with their `scales` by name. `dt` is the control step [s], or 1 for
        scales that are not per second. Sums are written to `total` (N,); with `only_positive` they are clipped at zero.
        """
        num_envs, device = len(total), total.device
        self._kernels = kernels
        self.functions = dict(functions)
        self.names = tuple(functions)
        self.scales = {name: scales[name] * dt for name in self.names}
        factors = [self.scales[name] for name in self.names]
        self._factors = torch.tensor(factors, device=device).view(len(factors), 1)
        before_clip = [float(name != "termination") for name in self.names]
        self._before_clip = torch.tensor(before_clip, device=device).view(len(factors), 1)
        self.only_positive = only_positive
        self.num_envs = num_envs
        self.total = total
        """(N,) reward of the last step."""
        self.sums = torch.zeros(len(self.names), num_envs, device=device)
        """(terms, N) sum of each scaled term over the episode so far."""
        self.last = torch.zeros_like(self.sums)
        """(terms, N) each scaled term of the last step."""
        self._zero = torch.zeros((), device=device)
        self.terms_finite = torch.ones(len(self.names), num_envs, dtype=torch.bool, device=device)
        """(terms, N) True where a term was finite at the last step."""
        self.episode_sums = {name: self.sums[i] for i, name in enumerate(self.names)}
        """The rows of `sums` by name."""

    def compute(self, valid: Tensor) -> Tensor:
        """Evaluate all terms, and return `total`. Robots outside `valid` (N,), whose physics has diverged, get zero. A term
        that is not finite counts as zero.

        Raises:
            TermError: a term fails, or returns neither (N,) nor one number.
        """
        if not self.functions:
            return self.total
        values = []
        for name, function in self.functions.items():
            with calling(f"_reward_{name}"):
                value = function()
                if isinstance(value, int | float):  # one number for all robots, such as `return 1.0` for being alive
                    value = torch.full_like(self.total, value)
                if not isinstance(value, Tensor):
                    raise ValueError(f"must return a tensor ({self.num_envs},), got {type(value).__name__}")
                if value.shape != (self.num_envs,):
                    raise ValueError(f"must return a tensor ({self.num_envs},), got {tuple(value.shape)}")
            values.append(value)
        # The values are stacked, so that scaling, masking and summing cost one launch each instead of one per term.
        stacked = torch.stack(values).float()
        if self._kernels is not None:
            rule = (self._factors, self._before_clip, valid, LARGEST, self.only_positive)
            written = (self.terms_finite, self.last, self.sums, self.total)
            self._kernels.launch("add_rewards", self.num_envs, stacked, *rule, *written)
            return self.total
        scaled = stacked * self._factors
        torch.lt(scaled.abs(), LARGEST, out=self.terms_finite)
        scaled = torch.where(self.terms_finite & valid, scaled, self._zero, out=self.last)
        self.sums.add_(scaled)
        if not self.only_positive:
            return torch.sum(scaled, dim=0, out=self.total)
        total = (scaled * self._before_clip).sum(dim=0).clamp(min=0.0)
        return self.total.copy_(total + (scaled * (1.0 - self._before_clip)).sum(dim=0))

    def reset(self, mask: Tensor) -> None:
        """Reset the sums of the robots in `mask` (N,) to zero."""
        masked_set_(self.sums.t(), mask, 0.0)
