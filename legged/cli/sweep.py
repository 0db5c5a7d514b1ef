"""`legged sweep`: search for good settings with many trainings, and write a report on the search."""

import argparse
import gc
import math
import os
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING

import torch

from legged.cli.train import train
from legged.commandline.arguments import IMPORT, import_given, pick_device
from legged.commandline.command import EXIT_FAILED, stopping_on_signals, sub_command
from legged.config.checks import shown
from legged.deploy.command_parser import argument, check_number
from legged.errors import ConfigError
from legged.learning.divergence import Diverged
from legged.learning.evaluations import Evaluated, reaches
from legged.learning.run_folder import NOTE_FILE
from legged.learning.runner import Runner
from legged.process.cores import available_cores
from legged.process.paths import make_folder, ready_to_write, relative, write_text
from legged.process.processes import Job, WorkerPool, why_failed
from legged.process.ranks import Ranks
from legged.sweeping.plan import Plan, plan_sweep, sweep_file
from legged.sweeping.trials import RUNS, WHY, Trials, repeating, write_report

if TYPE_CHECKING:
    from optuna import Trial

TELL_S = 1.0
"""Interval at which the results of the worker processes are read and printed [s]."""
MOST_STARTS = 10
"""Largest number of times that a worker is started. A worker that a signal has killed is started again."""
PRUNED = "ended early: other trials were better at the same stage"
SIGNALLED = 128
"""If a signal ended a training, the exit code is this number plus the signal's number."""
MOST_FAILURES = 3
"""Number of failed trials in a row after which a worker gives up."""


SWEEP = (
    argument("file", metavar="FILE", help="YAML file of the sweep, or the name of one in cfg/sweeps"),
    argument("--sim-device", help="cpu, cuda, or several GPUs for the jobs, e.g. cuda:0,cuda:1"),
    argument("--storage", help="where trials are stored: URL of a database that machines can share, or journal:<file>"),
    IMPORT,
)
"""Arguments that `run` and `report` share."""


def _settle(args: argparse.Namespace, trials: int | None = None) -> tuple[Plan, list[torch.device]]:
    """Return the plan that the sweep's file describes, and the devices of --sim-device. `trials` is the value of --trials.

    Raises:
        ConfigError: there is no such device, CPU and GPU are mixed, optuna is missing, or the file is wrong.
        RunError: the sweep's folder can't be written.
    """
    devices = [pick_device(name) for name in args.sim_device.split(",")] if args.sim_device else [pick_device(None)]
    if len({device.type for device in devices}) > 1:
        raise ConfigError(f"--sim-device: {shown(args.sim_device)}: trials on a CPU and on a GPU can't be compared")
    import_given(args)
    plan = plan_sweep(sweep_file(args.file), devices[0].type == "cpu", trials)
    ready_to_write(plan.folder)
    return plan, devices


@sub_command(
    "legged sweep run anymal_c_flat",
    "legged sweep run cfg/sweeps/anymal_c_flat.yaml --trials 60 --jobs 4",
    arguments=(
        *SWEEP,
        argument("--trials", type=int, help="number of trials of all processes together; by default from the file"),
        argument("--jobs", type=int, help="number of parallel processes; one for each device by default"),
        argument("--worker", type=int, metavar="NUMBER", help=argparse.SUPPRESS),
    ),
)
def run(args: argparse.Namespace) -> int:
    """Search for settings with which a task is learned better or sooner: `legged sweep run anymal_c_flat`.

    Optuna's TPE sampler chooses the settings of each trial. A trial is one or more trainings in logs/<name of the sweep>.
    Trials that fall behind are ended early. Run the command again to continue a sweep that was stopped or killed. Several
    processes, GPUs and machines can share a sweep through its storage. `legged sweep report` runs at the end.
    """
    if Ranks.now().several:
        raise ConfigError("sweep: can't run under torchrun, because a sweep starts its own processes; omit torchrun")
    check_number("--jobs", args.jobs, 1)
    check_number("--trials", args.trials, 1)
    plan, devices = _settle(args, args.trials)
    jobs = args.jobs or len(devices)
    trials = Trials(plan, args.storage or "", args.worker or 0)
    flags = ["--import", args.module] if args.module else []
    alone = ["--sim-device", str(devices[0]), *flags]
    if devices[0].type == "cpu" and jobs > 1:
        alone.append(f"sim.threads={max(1, available_cores() // jobs)}")
    if args.worker is not None:  # this process is a worker of another `legged sweep run`
        stopped_by = Worker(plan, trials, alone).run()
        return 128 + stopped_by[0] if stopped_by else 0
    trials.keep_to(devices[0].type)
    print(f"{plan.name}: {plan.given.trials} trials of {plan.cfg.task} for the {plan.objective_text}; {jobs} at once")
    beyond = [f"{path} {shown(plan.own[path])}" for path, drawn in plan.own_drawn.items() if drawn is None]
    if beyond:
        print(f"the task's own settings are not tried, because the sweep excludes these values: {', '.join(beyond)}")
    again = trials.take_back()
    if trials.all:
        numbers = f"; trials to try again: {', '.join(map(str, again))}" if again else ""
        done = f"{len(trials.finished)} of {plan.given.trials} trials are done"
        print(f"going on in {relative(plan.folder)}: {done}{numbers}", flush=True)
    if jobs == 1:
        stopped_by = Worker(plan, trials, alone).run()
    else:
        flags += ["--storage", args.storage] if args.storage else []
        stopped_by = _pool(trials, [str(sweep_file(args.file)), *flags], [str(device) for device in devices], jobs)
    print(*write_report(trials, args.module), sep="\n")
    if stopped_by:
        return 128 + stopped_by[0]
    return 0 if len(trials.finished) >= plan.given.trials else EXIT_FAILED


def _pool(trials: Trials, arguments: list[str], devices: list[str], jobs: int) -> list[int]:
    """Run trials in `jobs` worker processes; return the signals that this process received."""
    given, start, starts = trials.plan.given, time.perf_counter(), [0] * jobs
    pool = WorkerPool(jobs)
    told = {trial.number for trial in trials.finished}

    def say(text: str) -> None:
        print(f"{time.perf_counter() - start:7.1f} s  {text}", flush=True)

    def tell() -> None:
        """Print the trials that other processes have finished since the last call."""
        for trial in trials.finished:
            if trial.number not in told:
                told.add(trial.number)
                what = trial.user_attrs.get(WHY) if trial.value is None else f"{trial.value:.4g}"
                say(f"trial {trial.number:3d}  {what}  [{len(told)} of {given.trials}]")

    def job(number: int) -> Job:
        starts[number] += 1
        words = [sys.executable, "-m", "legged", "sweep", "run", *arguments, "--worker", str(number), "--jobs", str(jobs)]
        words += ["--sim-device", devices[number % len(devices)], "--trials", str(given.trials)]
        output = trials.plan.folder / "output" / f"worker{number}.txt"
        return Job(words, output, lambda ended, code: done(number, ended, code))

    def done(number: int, ended: Job, code: int) -> list[Job]:
        if code == 0 or pool.stopped:
            return []
        again = code < 0 and starts[number] < MOST_STARTS
        what = "another process takes its place" if again else f"see {relative(ended.output)}"
        say(f"process {number} has ended: {why_failed(ended, code)}; {what}")
        return [job(number)] if again else []

    with stopping_on_signals(pool.stop) as stopped_by, repeating(tell, TELL_S, at_end=True):
        pool.run([job(number) for number in range(jobs)])
    return stopped_by


class Stopped(Exception):
    """A signal ended a training. The exception's argument is the number of the signal."""


class NoValue(Exception):
    """A trial has no value of the objective, and counts as ended early. The exception's text is the reason."""


class Worker:
    """A process that runs trials one after another."""

    def __init__(self, plan: Plan, trials: Trials, flags: Sequence[str]) -> None:
        """`flags` are options for each `legged train`: device, threads and --import."""
        self.plan, self.trials, self._flags = plan, trials, [*flags]
        self._start = time.perf_counter()
        self._failures = 0
        self._stopped = False

    def run(self) -> list[int]:
        """Run trials until there are enough, or until the parent process has died; return the signals received."""
        parent, in_trials = os.getppid(), []
        with stopping_on_signals(self._stop) as stopped_by:
            while not self._stopped and os.getppid() == parent and (trial := self.trials.next()) is not None:
                try:
                    self._make(trial)
                except Stopped as signalled:  # raised if a training's own signal handler got the signal
                    self._stopped = True
                    in_trials.append(signalled.args[0])
        return [*stopped_by, *in_trials]

    def _stop(self) -> None:
        self._stopped = True

    def _make(self, trial: "Trial") -> None:
        """Run a trial, and store its result."""
        begun = time.perf_counter()

        def say(text: str) -> None:
            now = time.perf_counter()
            counted = f"[{len(self.trials.finished)} of {self.plan.given.trials}]"
            print(f"{now - self._start:7.1f} s  trial {trial.number:3d} ({now - begun:.1f} s)  {text}  {counted}", flush=True)

        try:
            with self.trials.alive(trial):
                value = self._value(trial)
        except NoValue as error:
            self.trials.end(trial, "PRUNED", str(error))
            say(str(error))
        except (Stopped, KeyboardInterrupt):
            self.trials.try_again(trial, "it was stopped")
            say("stopped; it will be tried again")
            raise
        except Exception as error:
            line = (" ".join(str(error).split()) or type(error).__name__)[:200]
            self._failures += 1
            self.trials.try_again(trial, f"it failed: {line}")
            say(f"failed: {line}")
            if self._failures >= MOST_FAILURES:
                raise
        else:
            self._failures = 0
            self.trials.study.tell(trial, value)
            say(f"{self.plan.objective_text}: {value:.4g}")
        finally:
            gc.collect()  # reference cycles keep tensors and graphs of a training alive
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

    def _value(self, trial: "Trial") -> float:
        """Train with every seed; return the mean value.

        Raises:
            NoValue: the trial was ended early, its settings are invalid, a training diverged, or `value_of` raised it.
            Stopped: a signal ended a training.
        """
        found: list[float] = []
        output = self.plan.folder / "output" / f"trial{trial.number:03d}.txt"
        make_folder(output.parent)
        with output.open("w", encoding="utf-8", buffering=1) as file, redirect_stdout(file), redirect_stderr(file):
            try:
                for seed in self.plan.given.seeds:
                    found.append(self._train(trial, seed, found))
            except (NoValue, Stopped):
                raise
            except (ConfigError, Diverged) as error:
                print(f"error: {error}", flush=True)
                raise NoValue(str(error)) from error
            except Exception:
                traceback.print_exc()
                raise
        return mean(found)

    def _train(self, trial: "Trial", seed: int, before: list[float]) -> float:
        """Train with one seed; return the value. `before` are values of earlier seeds. The errors are those of `_value`."""
        kept: list[Runner] = []
        until, plan, settings = self.plan.cfg.train.runner.max_iterations, self.plan, self.plan.settings(trial.params)

        def listen(found: Evaluated) -> str:
            """Report an evaluation to Optuna. Return the reason to end the training early, or an empty text to continue."""
            now = found.figures[plan.figure]
            if not math.isfinite(now):
                return ""
            value = mean([*before, now]) if not plan.until_target else -now if plan.negated else now
            trial.report(value, len(before) * until + found.iterations)
            return PRUNED if found.iterations < until and trial.should_prune() else ""

        def prepare(runner: Runner) -> None:
            assert runner.evaluations is not None, "the plan switches evaluations on"
            runner.evaluations.listener = listen
            kept.append(runner)

        words = [*plan.arguments(settings, trial.number, seed), *self._flags]
        code = train.run(train.parse(words), prepare)
        (runner,) = kept
        folder, evaluations = Path(runner.logger.log_dir), runner.evaluations
        assert evaluations is not None
        trial.set_user_attr(RUNS, [*trial.user_attrs.get(RUNS, []), relative(folder)])
        if evaluations.why_end == PRUNED:
            why = f"{PRUNED} (after {evaluations.history[-1].iterations} iterations)"
            write_text(folder / NOTE_FILE, f"{plan.note(settings, trial.number)}; {why}\n")
            raise NoValue(why)
        if code >= SIGNALLED:
            raise Stopped(code - SIGNALLED)
        return value_of(plan, evaluations.history)


def value_of(plan: Plan, history: Sequence[Evaluated]) -> float:
    """Return the value of the objective for a training.

    Raises:
        NoValue: the training did not reach the target, or no evaluation gave a finite figure.
    """
    objective, figure = plan.given.objective, plan.figure
    values = [found.figures[figure] for found in history if math.isfinite(found.figures[figure])]
    if not values:
        raise NoValue(f"its {figure} is not finite")
    if objective.take == "last":
        return values[-1]
    if objective.take == "best":
        return min(values) if plan.minimize else max(values)
    assert objective.target is not None, "the plan checks that there is a target"
    for found in history:
        if reaches(figure, found.figures[figure], objective.target):
            return found.loop_s if objective.take == "time" else float(found.steps)
    raise NoValue(f"its {figure} did not reach {objective.target:g}; the last was {values[-1]:.4g}")


@sub_command(
    "legged sweep report anymal_c_flat",
    "legged sweep report cfg/sweeps/anymal_c_flat.yaml --storage journal:sweep.log",
    arguments=SWEEP,
)
def report(args: argparse.Namespace) -> int:
    """Write table and figures of a sweep: `legged sweep report anymal_c_flat`.

    The files table.md, best.yaml and the figures are written into logs/<name of the sweep>. The sweep may still be running;
    the report covers the trials that have ended.
    """
    plan, _ = _settle(args)
    print(*write_report(Trials(plan, args.storage or ""), args.module), sep="\n")
    return 0
