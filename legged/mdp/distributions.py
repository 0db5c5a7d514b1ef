"""Random columns with a range and a distribution each (uniform, log-uniform or gaussian), made from uniform numbers."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from legged.config.randomization import DrawConfig
from legged.mdp.random_pool import RandomPool, Slice

KINDS = ("uniform", "log_uniform", "gaussian")


def standard_deviation(draw: DrawConfig) -> float:
    """Return `draw.std`, or a quarter of the range's width if `draw.std` is 0. This is the standard deviation of a normal
    distribution before its tails outside the range are cut off.
    """
    return draw.std or 0.25 * (draw.range[1] - draw.range[0])


class Distributions:
    """V random columns: uniform, uniform in their logarithm, or normal within a range."""

    def __init__(
        self,
        columns: Sequence[DrawConfig],
        neutral: Sequence[float],
        device: torch.device,
        steps_per_iteration: int = 1,
        within: bool = True,
    ) -> None:
        """Configure the columns. A range with `grow` widens over training, starting from the column's value in `neutral`
        (V,). With `within`, a neutral value outside the range is replaced by the nearest end.
        `steps_per_iteration` is the number of control steps in a training iteration.
        """
        self._order = sorted(range(len(columns)), key=lambda i: KINDS.index(columns[i].distribution))
        ordered = [columns[i] for i in self._order]
        self._counts = [sum(draw.distribution == kind for draw in ordered) for kind in KINDS]
        self._back = None
        if self._order != list(range(len(columns))):
            self._back = torch.tensor([self._order.index(i) for i in range(len(columns))], device=device)

        def tensor(values: Sequence[float] | Sequence[tuple[float, float]]) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        normal = [draw for draw in ordered if draw.distribution == "gaussian"]
        self._middle = tensor([0.5 * sum(draw.range) for draw in normal])
        self._spread = tensor([math.sqrt(2.0) * standard_deviation(draw) for draw in normal])
        ends = [_ends(draw) for draw in ordered]
        self.low, self.high = (tensor([end[k] for end in ends]) for k in range(2))
        """(V,) bounds of the uniform numbers, sorted by distribution."""
        self._least, self._most = (tensor([draw.range[k] for draw in columns]) for k in range(2))
        self._pace: tuple[Tensor, Tensor] | None = None
        """(V,) widening of each range in a step, and (V,) its width at the first step, as shares of the full width. None if
        no range widens."""
        if any(draw.grow[1] > 0.0 for draw in columns):
            paces = [1.0 / (draw.grow[1] - draw.grow[0]) if draw.grow[1] > 0.0 else 0.0 for draw in columns]
            first = [-draw.grow[0] * pace if pace else 1.0 for draw, pace in zip(columns, paces, strict=True)]
            self._pace = tensor([pace / steps_per_iteration for pace in paces]), tensor(first)
        self._neutral = tensor(neutral)
        if within:
            self._neutral = torch.minimum(torch.maximum(self._neutral, self._least), self._most)

    def ask(self, numbers: RandomPool) -> Slice:
        """Reserve in the pool `numbers` the uniform numbers that `values` takes."""
        return numbers.between(self.low, self.high, len(self.low))

    def at_once(self, count: int) -> Tensor:
        """Draw (count, V) numbers at once, without the pool of a control step. Ranges that widen have their initial width."""
        even = self.low + torch.rand(count, len(self.low), device=self.low.device) * (self.high - self.low)
        return self.values(even, torch.zeros((), device=even.device))

    def values(self, even: Tensor, steps: Tensor) -> Tensor:
        """Return (N, V) random numbers made from the uniform numbers `even` (N, V), which lie between `low` and `high`.
        `steps` () is the number of control steps for which ranges have widened.
        """
        parts = list(even.split(self._counts, dim=1))
        if self._counts[1]:
            parts[1] = parts[1].exp()
        if self._counts[2]:
            parts[2] = torch.erfinv(parts[2]) * self._spread + self._middle
        drawn = torch.cat(parts, dim=1) if any(self._counts[1:]) else even
        if self._back is not None:
            drawn = drawn.index_select(1, self._back)
        if any(self._counts[1:]):
            drawn = torch.clamp(drawn, self._least, self._most)  # rounding can carry a number slightly out of the range
        if self._pace is None:
            return drawn
        share = torch.addcmul(self._pace[1], self._pace[0], steps).clamp_(0.0, 1.0)
        return torch.lerp(self._neutral.expand_as(drawn), drawn, share.expand_as(drawn))


def _ends(draw: DrawConfig) -> tuple[float, float]:
    """Return the bounds of the uniform numbers that a column is made from."""
    low, high = draw.range
    if draw.distribution == "log_uniform":
        return math.log(low), math.log(high)
    if draw.distribution == "gaussian":  # `values` applies torch.erfinv, which is infinite at +-1
        reach = 0.5 * (high - low) / standard_deviation(draw) if high > low else 0.0
        end = min(math.erf(reach / math.sqrt(2.0)), 1.0 - 1e-6)
        return -end, end
    return low, high
