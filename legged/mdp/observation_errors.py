"""Errors of observations: a bias that is constant within an episode, noise, delay, and loss.

Errors are applied to terms once per control step, so that all observation groups with noise see the same errors.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from legged.math import masked_set_
from legged.mdp.height_map_errors import HeightMapErrors
from legged.mdp.random_pool import RandomPool

HEIGHTS = "heights"
"""Name of the term that is read from the height map."""


class ObservationErrors:
    """Observation terms of N robots with errors: bias and noise are added, then numbers are delayed, then some are lost.

    `values` and `columns` have the layout of `ObservationTerms`. Terms without errors are copied.
    """

    STATE: tuple[str, ...] = ("bias", "delay", "past", "held")

    def __init__(
        self,
        source: Tensor,
        columns: Mapping[str, slice],
        names: Sequence[str],
        bias: Mapping[str, float],
        delay: Mapping[str, tuple[int, int]],
        dropped: Mapping[str, float],
        noise: Mapping[str, float],
        numbers: RandomPool,
        height_map: HeightMapErrors | None = None,
    ) -> None:
        """Apply errors to the terms `names` of `source` (N, width), of which each term has its `columns`. Each table has
        entries by term; a missing entry means no such error.

        `bias` and `noise` are half widths of uniform distributions, in the term's unit. `delay` is the lowest and highest
        number of control steps. `dropped` is the share of control steps at which a term is lost. Random numbers come from the
        pool `numbers`. With `height_map`, the heights are read from that map.
        """
        self.columns, self.names = columns, tuple(sorted(names, key=lambda name: columns[name].start))
        self.noise = {name: noise.get(name, 0.0) for name in self.names}
        """Term -> half width of its noise, in the term's unit."""
        self._source, self._map = source, height_map
        self._shares, self._delays = (bias, dropped), delay
        num_envs, device = source.shape[0], source.device
        taken = [i for name in self.names for i in range(columns[name].start, columns[name].stop)]
        widths = [columns[name].stop - columns[name].start for name in self.names]
        term_of = [i for i, width in enumerate(widths) for _ in range(width)]
        self.values = torch.zeros_like(source)
        """(N, width) all terms, after errors were applied. Observation groups with noise read them."""
        together = taken == list(range(taken[0], taken[0] + len(taken)))
        self._slice = slice(taken[0], taken[0] + len(taken)) if together else None
        self._columns = torch.tensor(taken, device=device)
        self._term_of = torch.tensor(term_of, device=device)
        if height_map is not None and HEIGHTS in self.names:
            start = sum(widths[: self.names.index(HEIGHTS)])
            self._of_map: slice | None = slice(start, start + widths[self.names.index(HEIGHTS)])
        else:
            self._of_map = None

        def by_column(table: Mapping[str, float]) -> Tensor:
            return torch.tensor([float(table.get(self.names[i], 0.0)) for i in term_of], device=device)

        half, width = by_column(bias), by_column(noise)
        self._bias_drawn = numbers.between(-half, half, len(taken)) if half.any() else None
        self.bias = torch.zeros(num_envs, len(taken) if self._bias_drawn else 0, device=device)
        """(N, C) bias of the C columns that have errors, constant within an episode; (N, 0) without bias."""
        self._noise = numbers.between(-width, width, len(taken)) if width.any() else None
        low, high = (torch.tensor([delay.get(name, (0, 0))[k] for name in self.names], device=device) for k in (0, 1))
        self._longest = int(high.max())
        self._most = high
        self._delay_drawn = numbers.between(low.float(), high.float() + 1.0, len(high)) if self._longest else None
        self.delay = high.expand(num_envs, -1).clone()
        """(N, T) delay of the T terms that have errors, constant within an episode [control steps]."""
        self.past = torch.zeros(num_envs, self._longest + 1 if self._longest else 0, len(taken), device=device)
        """(N, steps, C) measurements of the last steps, newest first; (N, 0, C) without delay."""
        lost = torch.tensor([float(dropped.get(name, 0.0)) for name in self.names], device=device)
        self._dropped = lost if lost.any() else None
        self._lost_drawn = numbers.between(0.0, 1.0, len(lost)) if lost.any() else None
        self.held = torch.zeros(num_envs, len(taken) if self._lost_drawn else 0, device=device)
        """(N, C) last numbers that were not lost; (N, 0) without loss."""

    def update(self, begun: Tensor, again: bool = False) -> None:
        """Update `values` for a new control step. Robots of `begun` (N,) have new episodes: they get a new bias and delay,
        and their first measurement fills their past. With `again`, repeat the measurement of the same step.
        """
        if not again:
            self._draw(begun)
            if self._longest:
                self.past[:, 1:].copy_(self.past[:, :-1].clone())
        now = self._measured()
        if self._longest:
            self.past[:, 0].copy_(now)
            masked_set_(self.past, begun, now.unsqueeze(1).expand_as(self.past))
            now = self._late(self.past, self.delay)
        if self._lost_drawn is not None:
            lost = self._lost() & ~begun.unsqueeze(1)
            torch.where(lost, self.held, now, out=self.held)
            now = self.held
        self._show(now)

    def preview(self) -> None:
        """Write into `values` the measurement that a control step ending now would give. Nothing else changes."""
        now = self._measured()
        if self._longest:
            before = self._late(self.past, (self.delay - 1).clamp_(min=0))
            undelayed = (self.delay == 0).index_select(1, self._term_of)
            now = torch.where(undelayed, now, before)
        if self._lost_drawn is not None:
            now = torch.where(self._lost(), self.held, now)
        self._show(now)

    def describe(self, name: str) -> str:
        """Return the errors of a term in a few words."""
        bias, lost = (table.get(name, 0.0) for table in self._shares)
        low, high = self._delays.get(name, (0, 0))
        parts = [f"+-{self.noise[name]:.6g}"] if self.noise[name] else []
        parts += [f"bias +-{bias:.6g}"] if bias else []
        parts += [f"delay {low} to {high} steps"] if high else []
        parts += [f"dropped {lost:.3g}"] if lost else []
        parts += ["map with errors"] if self._map is not None and name == HEIGHTS else []
        return ", ".join(parts)

    def parts(self) -> dict[str, "ObservationErrors | HeightMapErrors"]:
        """Return the parts with tensors to save (`STATE`), by their names in saved states."""
        return {"sensors": self, **({"height_map": self._map} if self._map is not None else {})}

    def _draw(self, begun: Tensor) -> None:
        """Draw bias and delay of new episodes, and advance the errors of the map."""
        if self._bias_drawn is not None:
            masked_set_(self.bias, begun, self._bias_drawn.values)
        if self._delay_drawn is not None:
            masked_set_(self.delay, begun, torch.minimum(self._delay_drawn.values.long(), self._most))
        if self._map is not None:
            self._map.advance(begun)

    def _measured(self) -> Tensor:
        """Return the current values of the terms (N, C), with bias and noise."""
        source = self._source
        if self._map is not None and self.names == (HEIGHTS,):
            now = self._map.read()  # the heights are the only term with errors
        elif self._map is not None and self._of_map is not None:
            now = source.index_select(1, self._columns)
            now[:, self._of_map].copy_(self._map.read())
        else:
            now = source[:, self._slice] if self._slice is not None else source.index_select(1, self._columns)
        if self._bias_drawn is not None:
            now = now + self.bias
        if self._noise is not None:
            now = now + self._noise.values
        if self._of_map is not None and self._map is not None:
            self._map.cut_holes(now[:, self._of_map])
        return now

    def _late(self, past: Tensor, delay: Tensor) -> Tensor:
        """Return the values (N, C) in `past` (N, steps, C) that are `delay` (N, T) steps old."""
        age = delay.index_select(1, self._term_of).unsqueeze(1)
        return past.gather(1, age)[:, 0]

    def _lost(self) -> Tensor:
        """Return a mask (N, C) of the numbers that are lost in this step."""
        assert self._lost_drawn is not None
        assert self._dropped is not None
        return (self._lost_drawn.values < self._dropped).index_select(1, self._term_of)

    def _show(self, seen: Tensor) -> None:
        """Write the measured terms `seen` (N, C) into `values`, and copy all other terms."""
        self.values.copy_(self._source)
        if self._slice is not None:
            self.values[:, self._slice].copy_(seen)
        else:
            self.values.index_copy_(1, self._columns, seen)
