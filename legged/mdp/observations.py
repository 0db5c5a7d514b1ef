"""Observation groups: named terms, each evaluated once per step, then scaled, given noise, clipped and concatenated."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from legged.graph.step_graph import calling
from legged.math import masked_set_
from legged.mdp.observation_errors import ObservationErrors
from legged.mdp.random_pool import RandomPool


class ObservationTerms:
    """Observation terms of all groups of a task, each evaluated once per step, then concatenated."""

    def __init__(self, functions: Mapping[str, Callable[[], Tensor]]) -> None:
        """Call the function of each term once, to learn its width. Each returns (N, width).

        Raises:
            TermError: a term fails, or does not return (N, width).
            ValueError: there is no term.
        """
        self._functions = {name: of_one_shape(function) for name, function in functions.items()}
        self.columns: dict[str, slice] = {}
        """Term -> its columns in `values`."""
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
        """(N, width) terms as groups read them, with 0 in place of NaN and infinite numbers."""
        self.raw = self.values
        """(N, width) terms as their functions returned them, NaN and infinite numbers included."""
        self.errors: ObservationErrors | None = None
        """Errors of terms (bias, delay, loss) for groups with noise; None if no term has errors."""

    def evaluate(self, begun: Tensor | None = None, again: bool = False) -> None:
        """Evaluate all terms into `raw` and `values`, then update `errors` by a control step.

        Robots of `begun` (N,) have new episodes. With `again`, `errors` repeats the measurement of the same step. Without
        `begun`, `errors` shows the measurement that a step ending now would give, and keeps its state.

        Raises:
            TermError: a term fails.
        """
        found = []
        for name, function in self._functions.items():
            with calling(f"_obs_{name}"):
                found.append(function())
        self.raw = torch.cat(found, dim=1).float()
        torch.nan_to_num(self.raw, nan=0.0, posinf=0.0, neginf=0.0, out=self.values)
        if self.errors is not None and begun is None:
            self.errors.preview()
        elif self.errors is not None and begun is not None:
            self.errors.update(begun, again)


@dataclass(frozen=True)
class ObservationTerm:
    """One term of a group, with its columns in a step of the buffer."""

    name: str
    columns: slice
    scale: Tensor
    """(width,) factors."""
    noise: float
    """Half width of the uniform noise, in the term's unit before scaling."""


class ObservationGroup:
    """Input of a network, (N, history * width): the concatenated terms of the last `history` steps, oldest first. The buffer
    is rewritten in place.
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
        """Build the group of the terms `names` of `source`, in that order.

        `scales` and `noise` (half widths in the term's unit, before scaling) have entries by term. A missing entry means the
        scale 1, or no noise. Scaled values are clipped to plus and minus `clip`. Noise is drawn from the pool `numbers`.
        """
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
        """(N, history * width) input of the network."""
        self._now = self._steps[:, -1]
        # If the terms are side by side in `source.values`, one slice reads them. Otherwise columns are picked by index.
        together = columns == list(range(columns[0], columns[0] + start))
        self._values = source.values[:, columns[0] : columns[0] + start] if together else source.values
        self._columns = None if together else torch.tensor(columns, device=device)
        self._scale = torch.cat([term.scale for term in self.terms])
        half = torch.cat([torch.full_like(term.scale, term.noise) for term in self.terms])
        width = half * self._scale
        self.numbers = numbers or RandomPool(num_envs, device)
        self._noise = self.numbers.between(-width, width, start) if bool(half.any()) else None

    def advance(self) -> None:
        """Shift the history by one step, and drop the oldest."""
        if self.history > 1:
            self._steps[:, :-1].copy_(self._steps[:, 1:].clone())

    def compute(self) -> None:
        """Write the terms' values into the newest step."""
        self._write(self._now)

    def preview(self, out: Tensor) -> None:
        """Write into `out` (N, history * width) the buffer that `advance` and `compute` would give now. The group itself
        stays as it is.
        """
        steps = out.view_as(self._steps)
        if self.history > 1:
            steps[:, :-1].copy_(self._steps[:, 1:])
        self._write(steps[:, -1])

    def _write(self, step: Tensor) -> None:
        """Write the terms' values, scaled, with noise, and clipped, into `step` (N, width)."""
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


def of_one_shape(term: Callable[[], Tensor]) -> Callable[[], Tensor]:
    """Return a function that calls `term` and raises ValueError if the shape differs from the one of the first call."""
    first: Any = None

    @functools.wraps(term)
    def checked() -> Tensor:
        nonlocal first
        value = term()
        shape = getattr(value, "shape", None)
        first = shape if first is None else first
        if shape != first:
            raise ValueError(f"returned a tensor {tuple(shape or ())}, but {tuple(first)} in its first call")
        return value

    return checked
