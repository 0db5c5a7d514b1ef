"""Evaluations during a training: when they are due, which policy was the best, and whether a target is reached."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import nn

from legged.config import TaskConfig
from legged.envs.checks import lower_is_better
from legged.errors import ConfigError
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import BEST_MODEL
from legged.process.paths import write_bytes

SECTION = "Evaluation/"
"""How the names of the figures begin in TensorBoard."""


class Measurement(Protocol):
    """What measures a policy: legged.evaluation.during_training has one."""

    @property
    def figures(self) -> Sequence[str]:
        """What it finds; the first is what matters most."""

    def measure(self, policy: nn.Module) -> dict[str, float]:
        """Return figure -> value."""


@dataclass(frozen=True)
class Evaluated:
    """What one evaluation has found."""

    iterations: int
    """That the policy had been trained for."""
    figures: Mapping[str, float]
    loop_s: float
    """Time in iterations until then, of this process [s]."""
    steps: int
    """Of all robots until then, by this process."""


class Ended(Exception):
    """Training was ended by an evaluation; raised at the end of an iteration, when networks and optimiser agree."""


class Evaluations:
    """Evaluates a policy now and then, and remembers what was found."""

    def __init__(self, cfg: TaskConfig, measurement: Measurement, clock: Callable[[], float] = time.perf_counter) -> None:
        """`clock` gives seconds."""
        self._runner, self._measurement, self._clock = cfg.train.runner, measurement, clock
        self.best_by = self._runner.best_by or measurement.figures[0]
        """The figure by which the best policy is kept."""
        self.best: float | None = None
        """The best value of it so far."""
        self.history: list[Evaluated] = []
        """What was found, in that order."""
        self.spent_s = 0.0
        """Time that evaluations have taken [s]."""
        self._last_s = 0.0
        self._best_before: Path | None = None
        self.reached = False
        """Whether the target is reached."""
        self.why_end = ""
        """Why training should end; empty while it should not."""
        self.listener: Callable[[Evaluated], str] | None = None
        """Is told of every evaluation, and may say why training should end."""

    def may_be_due(self, iterations: int, total: int) -> bool:
        """Return whether to ask `due` after so many `iterations` of `total`: at every interval, and at the end."""
        return iterations == total or iterations % self._runner.evaluate_interval == 0

    def due(self, iterations: int, total: int, loop_s: float) -> bool:
        """Return whether to evaluate after so many `iterations` of `total`, which have taken `loop_s` [s]: at every interval,
        if there is time for it and for the last one, and at the end.
        """
        if iterations == total:
            return True
        if not self.may_be_due(iterations, total):
            return False
        share = self._runner.evaluate_share
        return share >= 1.0 or not self.history or self.spent_s + 2.0 * self._last_s <= share * loop_s

    def evaluate(self, policy: nn.Module, iterations: int, loop_s: float, steps: int) -> bool:
        """Measure a policy that was trained for so many `iterations`, `loop_s` seconds and `steps`; return whether it is the
        best so far. Afterwards `why_end` says whether training should end.
        """
        start = self._clock()
        found = Evaluated(iterations, self._measurement.measure(policy), loop_s, steps)
        self._last_s = self._clock() - start
        self.spent_s += self._last_s
        self.history.append(found)
        value = found.figures[self.best_by]
        improved = math.isfinite(value) and (self.best is None or is_better(self.best_by, value, self.best))
        if improved:
            self.best = value
        self._judge(found)
        return improved

    def _judge(self, found: Evaluated) -> None:
        """Decide whether training should end."""
        target = self._runner.stop_at
        if target and all(reaches(name, found.figures[name], value) for name, value in target.items()):
            self.reached = True
            values = ", ".join(f"{name} {found.figures[name]:.4g} (stop_at {value:g})" for name, value in target.items())
            self.why_end = f"reached its target after {found.iterations} iterations: {values}"
        if self.listener is not None and not self.why_end:
            self.why_end = self.listener(found)

    def summary(self, loop_s: float) -> list[str]:
        """Return lines on what was found in a training whose iterations took `loop_s` [s]."""
        lines = [self.why_end] if self.why_end else []
        if self.best is not None:
            how = f"{self.best_by} {self.best:.4g}"
            share = 100.0 * self.spent_s / max(loop_s, 1e-9)
            count = len(self.history)
            times = (
                f"{count} evaluation{'s' if count != 1 else ''} in {self.spent_s:.1f} s ({share:.1f} % of the training loop)"
            )
            lines.append(f"best policy: {how}, in {BEST_MODEL}; {times}")
        return lines

    def go_on_from(self, checkpoint: Path) -> None:
        """Take over the best policy of the run that a training is resumed from, if it is not younger than its `checkpoint`,
        and if it was judged by the same figure.
        """
        path = checkpoint.with_name(BEST_MODEL)
        try:
            best, iteration = read_checkpoint(path), read_checkpoint(checkpoint)["iter"]
        except ConfigError:  # there is none
            return
        value = best["infos"].get("evaluation", {}).get(self.best_by)
        if value is not None and best["iter"] <= iteration:
            self.best, self._best_before = value, path

    def begin_in(self, folder: Path) -> None:
        """Copy the best policy from before into the folder of a run that begins.

        Raises:
            RunError: it can't be written.
        """
        if self._best_before is not None:
            write_bytes(folder / BEST_MODEL, self._best_before.read_bytes())


def is_better(figure: str, value: float, than: float) -> bool:
    """Return whether a value of a figure is better than another one."""
    return value < than if lower_is_better(figure) else value > than


def reaches(figure: str, value: float, target: float) -> bool:
    """Return whether a value of a figure is as good as its target."""
    return value == target or is_better(figure, value, target)
