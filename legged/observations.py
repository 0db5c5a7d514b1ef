"""Observation groups: named terms, scaled, noised, clipped and laid side by side in one buffer."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from legged.graph import calling
from legged.math import masked_set_


@dataclass(frozen=True)
class ObservationTerm:
    """One term of a group and where it lies in the buffer."""

    name: str
    function: Callable[[], Tensor]
    columns: slice
    scale: Tensor
    """(width,) factors."""
    noise: float
    """Half width of the uniform noise, in the term's unit before scaling."""


class ObservationGroup:
    """What one network sees: (N, width), rewritten in place; or with a history, the last steps side by side, oldest first:
    (N, history * width).
    """

    def __init__(
        self,
        functions: Mapping[str, Callable[[], Tensor]],
        scales: Mapping[str, Sequence[float] | float],
        noise: Mapping[str, float],
        clip: float,
        history: int = 1,
    ) -> None:
        """Functions by term, in order; each is called once to learn its width. No noise where none is named."""
        self.clip, self.history = clip, history
        self.terms: list[ObservationTerm] = []
        start = 0
        sample = None
        for name, function in functions.items():
            with calling(f"_obs_{name}"):
                sample = function()
                if sample.dim() != 2:
                    raise ValueError(f"must return a tensor (num_envs, width), got {tuple(sample.shape)}")
            width = sample.shape[1]
            scale = torch.as_tensor(scales.get(name, 1.0), dtype=torch.float32, device=sample.device).expand(width)
            self.terms.append(ObservationTerm(name, function, slice(start, start + width), scale, noise.get(name, 0.0)))
            start += width
        if sample is None:
            raise ValueError("an observation group needs at least one term")
        self._steps = torch.zeros(sample.shape[0], history, start, device=sample.device)
        self.buffer = self._steps.flatten(1)
        """(N, history * width) what the network is given."""
        self._now = self._steps[:, -1]
        self._scale = torch.cat([term.scale for term in self.terms])
        half = torch.cat([torch.full_like(term.scale, term.noise) for term in self.terms])
        self._noise_width = half * self._scale if bool(half.any()) else None
        self._noise = torch.zeros(sample.shape[0], start, device=sample.device)

    def draw(self) -> None:
        """Draw the noise of the next `compute`."""
        if self._noise_width is not None:
            self._noise.uniform_(-1.0, 1.0).mul_(self._noise_width)

    def advance(self) -> None:
        """Make room for a new step, forgetting the oldest."""
        if self.history > 1:
            self._steps[:, :-1].copy_(self._steps[:, 1:].clone())

    def compute(self) -> None:
        """Evaluate all terms into the newest step."""
        values = []
        for term in self.terms:
            with calling(f"_obs_{term.name}"):
                values.append(term.function())
        raw = torch.cat(values, dim=1)
        torch.addcmul(self._noise, raw, self._scale, out=self._now)
        self._now.clamp_(-self.clip, self.clip)

    def restart(self, mask: Tensor) -> None:
        """Fill the history of the robots in `mask` (N,) with the newest step."""
        if self.history > 1:
            masked_set_(self._steps, mask, self._now.unsqueeze(1).expand_as(self._steps))
