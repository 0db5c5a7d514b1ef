"""A process that runs trials one after the other, so that imports and kernels are loaded once."""

import gc
import math
import os
import time
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

import torch

from legged.cli.train import train_as_asked
from legged.commandline.stopping import stopping_on_signals
from legged.errors import ConfigError
from legged.learning.divergence import Diverged
from legged.learning.evaluations import Evaluated, reaches
from legged.learning.run_folder import NOTE_FILE
from legged.learning.runner import Runner
from legged.process.paths import make_folder, relative, write_text
from legged.sweeping.plan import Plan
from legged.sweeping.study import RUNS, WHY, Trials

if TYPE_CHECKING:
    from optuna import Trial

PRUNED = "ended early: others were better at that step"
SIGNALLED = 128
"""Exit codes from here on mean that a signal ended a training."""
MOST_FAILURES = 3
"""Failed trials in a row after which a worker gives up."""


class Stopped(Exception):
    """A training was ended by a signal."""

    def __init__(self, number: int) -> None:
        """Store the number of the signal."""
        super().__init__(f"signal {number}")
        self.number = number


class NoValue(Exception):
    """A trial without a value, which counts as ended early; the text is the reason."""


class Worker:
    """Runner of trials."""

    def __init__(self, plan: Plan, trials: Trials, flags: Sequence[str]) -> None:
        """Store the options of `legged train` for device and threads."""
        self.plan, self.trials, self._flags = plan, trials, [*flags]
        self._start = time.perf_counter()
        self._failures = 0
        self._parent = os.getppid()
        self.stopped = False

    def run(self) -> list[int]:
        """Run trials until there are enough, or until the parent process has died; return the signals received."""
        in_trials: list[int] = []
        with stopping_on_signals(self.stop) as stopped_by:
            while not self.stopped and os.getppid() == self._parent and (trial := self.trials.next()) is not None:
                try:
                    self._make(trial)
                except Stopped as signalled:  # a training handles signals itself
                    self.stopped = True
                    in_trials.append(signalled.number)
        return [*stopped_by, *in_trials]

    def stop(self) -> None:
        """Begin no further trial."""
        self.stopped = True

    def _make(self, trial: "Trial") -> None:
        """Run a trial, and store its result."""
        values = self.trials.draw(trial)
        begun = time.perf_counter()
        try:
            with self.trials.alive(trial):
                value = self._value(trial, values)
        except NoValue as error:
            trial.set_user_attr(WHY, str(error))
            self.trials.study.tell(trial.number, state=_state("PRUNED"))
            self._say(trial, begun, str(error))
        except (Stopped, KeyboardInterrupt):
            self._try_again(trial, "it was stopped")
            self._say(trial, begun, "stopped; it will be tried again")
            raise
        except Exception as error:
            self._failures += 1
            self._try_again(trial, f"it failed: {_line_of(error)}")
            self._say(trial, begun, f"failed: {_line_of(error)}")
            if self._failures >= MOST_FAILURES:
                raise
        else:
            self._failures = 0
            self.trials.study.tell(trial.number, value)
            self._say(trial, begun, f"{self.plan.objective_text}: {value:.4g}")
        finally:
            gc.collect()  # tensors and graphs of a training are in reference cycles
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

    def _try_again(self, trial: "Trial", why: str) -> None:
        (frozen,) = [one for one in self.trials.all if one.number == trial.number]
        self.trials.try_again(frozen, why)

    def _value(self, trial: "Trial", values: dict[str, Any]) -> float:
        """Train with every seed; return the mean value.

        Raises:
            NoValue: the trial was ended early, its settings are invalid, or its numbers diverged.
            Stopped: a signal ended it.
        """
        found: list[float] = []
        output = self.plan.folder / "output" / f"trial{trial.number:03d}.txt"
        make_folder(output.parent)
        with output.open("w", encoding="utf-8", buffering=1) as file, redirect_stdout(file), redirect_stderr(file):
            for seed in self.plan.given.seeds:
                try:
                    found.append(self._train(trial, values, seed, found))
                except NoValue:
                    raise
                except (ConfigError, Diverged) as error:
                    print(f"error: {error}", flush=True)
                    raise NoValue(str(error)) from error
                except Exception:
                    traceback.print_exc()
                    raise
        return mean(found)

    def _train(self, trial: "Trial", values: dict[str, Any], seed: int, before: list[float]) -> float:
        """Train with one seed; return its value. Raises as `_value`."""
        kept: list[Runner] = []
        until = self.plan.cfg.train.runner.max_iterations

        def listen(found: Evaluated) -> str:
            """Report the mean over the seeds so far; return a reason to end if others were better by this step."""
            now = found.figures[self.plan.figure]
            if not math.isfinite(now):
                return ""
            step = len(before) * until + found.iterations
            if self.plan.until_target:
                trial.report(-now if self.plan.negated else now, step)
            else:
                trial.report(mean([*before, now]), step)
            return PRUNED if found.iterations < until and trial.should_prune() else ""

        def prepare(runner: Runner) -> None:
            kept.append(runner)
            assert runner.evaluations is not None, "the plan switches them on"
            runner.evaluations.listener = listen

        code = train_as_asked([*self.plan.arguments(values, trial.number, seed), *self._flags], prepare)
        (runner,) = kept
        evaluations = runner.evaluations
        assert evaluations is not None
        runs = [*trial.user_attrs.get(RUNS, []), relative(Path(runner.logger.log_dir))]
        trial.set_user_attr(RUNS, runs)
        if evaluations.why_end == PRUNED:
            why = f"{PRUNED} (after {evaluations.history[-1].iterations} iterations)"
            write_text(Path(runner.logger.log_dir) / NOTE_FILE, f"{self.plan.note(values, trial.number)}; {why}\n")
            raise NoValue(why)
        if code >= SIGNALLED:
            raise Stopped(code - SIGNALLED)
        return self._taken(evaluations.history)

    def _taken(self, history: Sequence[Evaluated]) -> float:
        """Return the value of the objective for a training.

        Raises:
            NoValue: it did not reach its target, or no figure is finite.
        """
        objective, figure = self.plan.given.objective, self.plan.figure
        values = [found.figures[figure] for found in history if math.isfinite(found.figures[figure])]
        if not values:
            raise NoValue(f"its {figure} is not finite")
        if objective.take == "last":
            return values[-1]
        if objective.take == "best":
            return min(values) if self.plan.minimize else max(values)
        assert objective.target is not None, "the plan has seen to it"
        for found in history:
            if reaches(figure, found.figures[figure], objective.target):
                return found.loop_s if objective.take == "time" else float(found.steps)
        raise NoValue(f"its {figure} did not reach {objective.target:g}; the last was {values[-1]:.4g}")

    def _say(self, trial: "Trial", begun: float, text: str) -> None:
        now = time.perf_counter()
        done, wanted = self.trials.done, self.plan.given.trials
        print(
            f"{now - self._start:7.1f} s  trial {trial.number:3d} ({now - begun:.1f} s)  {text}  [{done} of {wanted}]",
            flush=True,
        )


def _line_of(error: BaseException) -> str:
    """Return an error on one line."""
    return (" ".join(str(error).split()) or type(error).__name__)[:200]


def _state(name: str) -> Any:
    """Return Optuna's state of a trial."""
    from optuna.trial import TrialState

    return TrialState[name]
