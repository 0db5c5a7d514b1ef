"""Pool of the random numbers of a step, drawn all at once."""

import random
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

Bounds = Tensor | Sequence[float] | float


class Slice:
    """Columns of the pool that belong to one part of a task."""

    values: Tensor
    """(N, width) numbers of the last draw. It is always the same tensor."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        """Set the bounds `low` (width,) and `high` (width,) of each column."""
        self.low, self.high = low, high


class RandomPool:
    """Uniform random numbers of N environments. Two kernel launches draw the numbers for all parts of a task; separate draws
    would take two launches for each part. The parts reserve their columns while the task is built.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.num_envs, self.device = num_envs, device
        self._slices: list[Slice] = []
        self._values: Tensor | None = None

    def between(self, low: Bounds, high: Bounds, width: int) -> Slice:
        """Reserve `width` columns with bounds `low` and `high`, and return them. A bound is one number for all columns, or
        one for each.

        Raises:
            RuntimeError: the pool has been allocated already.
        """
        if self._values is not None:
            raise RuntimeError(
                "random numbers must be reserved before the first draw: call numbers.between() in _init_buffers"
            )
        bounds = (torch.as_tensor(bound, dtype=torch.float32, device=self.device).expand(width) for bound in (low, high))
        self._slices.append(Slice(*bounds))
        return self._slices[-1]

    def allocate(self) -> None:
        """Allocate the reserved columns, filled with zeros."""
        widths = [len(drawn.low) for drawn in self._slices]
        self._values = torch.zeros(self.num_envs, sum(widths), device=self.device)
        for drawn, values in zip(self._slices, self._values.split(widths, dim=1), strict=True):
            drawn.values = values
        empty = [torch.zeros(0, device=self.device)]
        self._low = torch.cat([drawn.low for drawn in self._slices] or empty)
        self._span = torch.cat([drawn.high for drawn in self._slices] or empty) - self._low

    def draw(self) -> None:
        """Draw new numbers into all columns."""
        if self._values is None:
            self.allocate()
        if self._slices:
            self._values.uniform_()  # type: ignore[union-attr]
            torch.addcmul(self._low, self._values, self._span, out=self._values)  # type: ignore[arg-type]


def seed_host(seed: int) -> None:
    """Seed the global random generators of Python and NumPy, which methods of users may read."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
