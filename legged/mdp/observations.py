"""Observation groups: named terms, each evaluated once a step, then scaled, noised, clipped and laid side by side."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from legged.graph.step_graph import calling
from legged.math import masked_set_
from legged.mdp.observation_errors import ObservationErrors
from legged.mdp.random_pool import RandomPool


class ObservationTerms:
    """The terms that a task's groups name, evaluated once a step for all of them and laid side by side."""

    def __init__(self, functions: Mapping[str, Callable[[], Tensor]]) -> None:
        """Take functions by term, in order, each (N, width); each is called once to learn its width."""
        self._functions = dict(functions)
        self.columns: dict[str, slice] = {}
        """Term -> where it lies in `values`."""
        start = 0
        sample = None
        for name, function in self._functions.items():
            with calling(f"_obs_{name}"):
                sample = function()
                if sample.dim() != 2:
                    raise ValueError(f"must return a tensor (num_envs, width), got {tuple(sample.shape)}")
            self.columns[name] = slice(start, start + sample.shape[1])
            start += sample.shape[1]
        if sample is None:
            raise ValueError("observations need at least one term")
        self.values = torch.zeros(sample.shape[0], start, device=sample.device)
        """(N, width) the terms as groups read them, with 0 for what is no number."""
        self.raw = self.values
        """(N, width) the terms as they gave them, numbers or not."""
        self.sensors: ObservationErrors | None = None
        """What measures some of the terms, for groups with noise; None if sensors are ideal but for their noise."""

    def evaluate(self, begun: Tensor | None = None, again: bool = False) -> None:
        """Bring `raw` and `values` up to date, and the sensors: by a control step, in which the episodes of `begun` (N,) are
        new, or `again` in the same one; without `begun` they only show what they would measure.
        """
        found = []
        for name, function in self._functions.items():
            with calling(f"_obs_{name}"):
                found.append(function())
        self.raw = torch.cat(found, dim=1).float()
        torch.nan_to_num(self.raw, nan=0.0, posinf=0.0, neginf=0.0, out=self.values)
        if self.sensors is not None and begun is None:
            self.sensors.preview()
        elif self.sensors is not None and begun is not None:
            self.sensors.update(begun, again)


@dataclass(frozen=True)
class ObservationTerm:
    """One term of a group and where it lies in the buffer."""

    name: str
    columns: slice
    scale: Tensor
    """(width,) factors."""
    noise: float
    """Half width of the uniform noise, in the term's unit before scaling."""


class ObservationGroup:
    """What one network sees: (N, width), rewritten in place; or with a history, the last steps side by side, oldest first:
    (N, history * width).
    """

    STATE = ("_steps",)

    def __init__(
        self,
        source: ObservationTerms | ObservationErrors,
        names: Sequence[str],
        scales: Mapping[str, Sequence[float] | float],
        noise: Mapping[str, float],
        clip: float,
        history: int = 1,
        numbers: RandomPool | None = None,
    ) -> None:
        """Make the group of the terms `names` of `source`, in that order. No noise where none is named."""
        self.clip, self.history = clip, history
        self.terms: list[ObservationTerm] = []
        num_envs, device = source.values.shape[0], source.values.device
        start = 0
        columns: list[int] = []
        for name in names:
            there = source.columns[name]
            width = there.stop - there.start
            columns += range(there.start, there.stop)
            scale = torch.as_tensor(scales.get(name, 1.0), dtype=torch.float32, device=device).expand(width)
            self.terms.append(ObservationTerm(name, slice(start, start + width), scale, noise.get(name, 0.0)))
            start += width
        self._steps = torch.zeros(num_envs, history, start, device=device)
        self.buffer = self._steps.flatten(1)
        """(N, history * width) what the network is given."""
        self._now = self._steps[:, -1]
        # Terms that lie side by side already are read where they are; others are picked column by column.
        together = columns == list(range(columns[0], columns[0] + start))
        self._values = source.values[:, columns[0] : columns[0] + start] if together else source.values
        self._columns = None if together else torch.tensor(columns, device=device)
        self._scale = torch.cat([term.scale for term in self.terms])
        half = torch.cat([torch.full_like(term.scale, term.noise) for term in self.terms])
        width = half * self._scale
        self.numbers = numbers or RandomPool(num_envs, device)
        self._noise = self.numbers.between(-width, width, start) if bool(half.any()) else None

    def advance(self) -> None:
        """Make room for a new step, forgetting the oldest."""
        if self.history > 1:
            self._steps[:, :-1].copy_(self._steps[:, 1:].clone())

    def compute(self) -> None:
        """Take the terms' values into the newest step."""
        self._write(self._now)

    def preview(self, out: Tensor) -> None:
        """Write into `out` (N, history * width) what `advance` and `compute` would make of the terms' values now; the group
        itself stays as it is.
        """
        steps = out.view_as(self._steps)
        if self.history > 1:
            steps[:, :-1].copy_(self._steps[:, 1:])
        self._write(steps[:, -1])

    def _write(self, step: Tensor) -> None:
        """Write the terms' values, scaled, noised and clipped, into `step` (N, width)."""
        values = self._values if self._columns is None else self._values.index_select(1, self._columns)
        if self._noise is None:
            torch.mul(values, self._scale, out=step)
        else:
            torch.addcmul(self._noise.values, values, self._scale, out=step)
        step.clamp_(-self.clip, self.clip)

    def restart(self, mask: Tensor) -> None:
        """Fill the history of the robots in `mask` (N,) with the newest step."""
        if self.history > 1:
            masked_set_(self._steps, mask, self._now.unsqueeze(1).expand_as(self._steps))
