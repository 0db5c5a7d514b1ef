"""Observation groups of a task, and the simulated sensor errors of the groups with noise."""

import functools
from collections.abc import Callable
from typing import Any

from torch import Tensor

from legged.config.networks import groups_in
from legged.config.schema import TaskConfig
from legged.mdp.height_map_errors import HeightMapErrors
from legged.mdp.observation_errors import HEIGHTS, ObservationErrors
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.random_pool import RandomPool


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


class ObservingTask:
    """Mixin of BaseTask that builds the observation groups and their simulated sensor errors."""

    cfg: TaskConfig  # type: ignore[assignment]
    observation_terms: ObservationTerms
    numbers: RandomPool

    def observation_scales(self) -> dict[str, Any]:
        """Return the factor on each term: one number, or one for each of its columns. A missing term has the factor 1."""
        return dict(self.cfg.observations.scales)

    def make_height_map(self) -> HeightMapErrors | None:
        """Return the inexact height map from which the term `heights` is read; None if the map has no errors."""
        return None

    def make_observation_errors(self) -> ObservationErrors | None:
        """Return the object that adds bias, delay, loss and errors of the height map to terms. Return None if no group with
        noise has a term with such errors.
        """
        cfg, noise = self.cfg.observations, self._noise()
        noisy = {term for group in cfg.groups.values() if group.noise for term in group.terms} if cfg.add_noise else set()
        height_map = self.make_height_map() if HEIGHTS in noisy else None
        named = {name for table in (cfg.bias, cfg.dropped) for name, value in table.items() if value}
        named |= {name for name, (_, most) in cfg.delay.items() if most}
        measured = noisy & (named | ({HEIGHTS} if height_map is not None else set()))
        if not measured:
            return None
        errors = (cfg.bias, cfg.delay, cfg.dropped)
        return ObservationErrors(self.observation_terms, sorted(measured), *errors, noise, self.numbers, height_map)

    def _noise(self) -> dict[str, float]:
        """Return the half width of each term's noise, in the term's unit."""
        cfg = self.cfg.observations
        return {term: half * cfg.noise_level for term, half in cfg.noise.items()}

    def _group(self, name: str) -> ObservationGroup:
        """Build the observation group `name`."""
        cfg, terms = self.cfg.observations, self.observation_terms
        group = groups_in(self.cfg)[name]
        noisy = group.noise and cfg.add_noise
        noise = self._noise() if noisy else {}
        measured = terms.errors if noisy else None
        if measured is not None:  # terms with errors get their noise in `ObservationErrors`
            noise = {term: half for term, half in noise.items() if term not in measured.names}
        scales = self.observation_scales()
        return ObservationGroup(measured or terms, group.terms, scales, noise, cfg.clip, group.history, self.numbers)
