"""The random numbers of a step, drawn all at once."""

from collections.abc import Sequence

import torch
from torch import Tensor

Bounds = Tensor | Sequence[float] | float


class Slice:
    """Some of the numbers: those that one part of a task has asked for."""

    values: Tensor
    """(N, width) of the last draw; always the same tensor."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        """Draw from `low` (width,) up to `high` (width,)."""
        self.low, self.high = low, high


class RandomPool:
    """Random numbers of N environments, spread evenly between bounds: two launches for all of them, where each part by
    itself would take as many. Parts ask for theirs while the task is built.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.num_envs, self.device = num_envs, device
        self._asked: list[Slice] = []
        self._values: Tensor | None = None

    def between(self, low: Bounds, high: Bounds, width: int) -> Slice:
        """Return where `width` numbers of each environment will be found; bounds are one for all or one for each.

        Raises:
            RuntimeError: numbers have been drawn already.
        """
        if self._values is not None:
            raise RuntimeError("random numbers must be asked for before the first are drawn: in _init_buffers")
        bounds = (torch.as_tensor(bound, dtype=torch.float32, device=self.device).expand(width) for bound in (low, high))
        self._asked.append(Slice(*bounds))
        return self._asked[-1]

    def allocate(self) -> None:
        """Give those that have been asked for their place, as zeros."""
        widths = [len(drawn.low) for drawn in self._asked]
        self._values = torch.zeros(self.num_envs, sum(widths), device=self.device)
        for drawn, values in zip(self._asked, self._values.split(widths, dim=1), strict=True):
            drawn.values = values
        empty = [torch.zeros(0, device=self.device)]
        self._low = torch.cat([drawn.low for drawn in self._asked] or empty)
        self._span = torch.cat([drawn.high for drawn in self._asked] or empty) - self._low

    def draw(self) -> None:
        """Draw all numbers anew."""
        if self._values is None:
            self.allocate()
        if self._asked:
            self._values.uniform_()  # type: ignore[union-attr]
            torch.addcmul(self._low, self._values, self._span, out=self._values)  # type: ignore[arg-type]
