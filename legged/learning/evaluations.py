"""Evaluations during a training: the schedule, the best policy so far, and the target at which training ends."""

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
"""Prefix of the evaluations' figures in TensorBoard."""


class Measurement(Protocol):
    """Interface of an object that measures a policy. Implementation: legged.evaluation.during_training."""

    @property
    def figures(self) -> Sequence[str]:
        """Names of the measured figures, the most important one first."""

    def measure(self, policy: nn.Module) -> dict[str, float]:
        """Measure a policy and return figure -> value."""


@dataclass(frozen=True)
class Evaluated:
    """Result of one evaluation."""

    iterations: int
    """Number of iterations for which the policy had been trained."""
    figures: Mapping[str, float]
    loop_s: float
    """Time that this process had spent in iterations [s]."""
    steps: int
    """Control steps of all robots since this process began."""


class Ended(Exception):
    """Error that ends the training after an evaluation. It is raised between iterations, when networks and optimiser are
    consistent.
    """


class Evaluations:
    """Regular evaluations of a policy during training, with their results."""

    def __init__(self, cfg: TaskConfig, measurement: Measurement, clock: Callable[[], float] = time.perf_counter) -> None:
        """Take the settings of `cfg`, the measurement, and a `clock` that returns seconds."""
        self._runner, self._measurement, self._clock = cfg.train.runner, measurement, clock
        self.best_by = self._runner.best_by or measurement.figures[0]
        """Figure that decides which policy is the best."""
        self.best: float | None = None
        """Best value of the figure `best_by` so far."""
        self.history: list[Evaluated] = []
        """Results of all evaluations, in order."""
        self.spent_s = 0.0
        """Time spent on evaluations [s]."""
        self._last_s = 0.0
        self._best_before: Path | None = None
        self.reached = False
        """True if the target has been reached."""
        self.why_end = ""
        """Reason why training should end; empty if it should go on."""
        self.listener: Callable[[Evaluated], str] | None = None
        """Function that receives every result and returns a reason to end the training, or an empty text."""

    def may_be_due(self, iterations: int, total: int) -> bool:
        """Return True if an evaluation may be due after `iterations`: at every `evaluate_interval`, and at `total`."""
        return iterations == total or iterations % self._runner.evaluate_interval == 0

    def due(self, iterations: int, total: int, loop_s: float) -> bool:
        """Return True if an evaluation is due after `iterations` of `total` iterations and `loop_s` [s] of training.

        An evaluation is due at the end. At every `evaluate_interval` it is due if it is the first, or if the share
        `evaluate_share` of the training time is enough for two more evaluations: this one and the one at the end.
        """
        if iterations == total:
            return True
        if not self.may_be_due(iterations, total):
            return False
        share = self._runner.evaluate_share
        return share >= 1.0 or not self.history or self.spent_s + 2.0 * self._last_s <= share * loop_s

    def evaluate(self, policy: nn.Module, iterations: int, loop_s: float, steps: int) -> bool:
        """Measure a policy after `iterations` of training, which took `loop_s` [s] and `steps` control steps. Return True if
        it is the best policy so far. Also set `why_end` if training should end.
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
        """Set `why_end` if the target is reached, or if the function `listener` returns a reason."""
        target = self._runner.stop_at
        if target and all(reaches(name, found.figures[name], value) for name, value in target.items()):
            self.reached = True
            values = ", ".join(f"{name} {found.figures[name]:.4g} (stop_at {value:g})" for name, value in target.items())
            self.why_end = f"the training reached its target after {found.iterations} iterations: {values}"
        if self.listener is not None and not self.why_end:
            self.why_end = self.listener(found)

    def summary(self, loop_s: float) -> list[str]:
        """Return summary lines for a training whose iterations took `loop_s` [s]."""
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
        """Take over the best policy of the resumed run, unless that policy is newer than `checkpoint` or has no value of the
        figure `best_by`.
        """
        path = checkpoint.with_name(BEST_MODEL)
        try:
            best, iteration = read_checkpoint(path), read_checkpoint(checkpoint)["iter"]
        except ConfigError:  # the run has no best policy that can be read
            return
        value = best["infos"].get("evaluation", {}).get(self.best_by)
        if value is not None and best["iter"] <= iteration:
            self.best, self._best_before = value, path

    def begin_in(self, folder: Path) -> None:
        """Copy the best policy of the resumed run into the new run's folder.

        Raises:
            RunError: the file can't be written.
        """
        if self._best_before is not None:
            write_bytes(folder / BEST_MODEL, self._best_before.read_bytes())


def is_better(figure: str, value: float, than: float) -> bool:
    """Return True if `value` is better than the value `than` of the same figure."""
    return value < than if lower_is_better(figure) else value > than


def reaches(figure: str, value: float, target: float) -> bool:
    """Return True if a value of a figure is at least as good as its target."""
    return value == target or is_better(figure, value, target)
