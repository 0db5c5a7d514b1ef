"""Search settings that learn better or sooner: `legged sweep run anymal_c_flat`.

Optuna's TPE sampler draws the settings of each trial. A trial is an ordinary run in logs/<name of the sweep>; trials that
fall behind are ended early. A sweep that was stopped or killed continues. Several processes, GPUs and machines share one
sweep through its storage. At the end the folder gets table.md, best.yaml and figures, as `legged sweep report` makes them.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from legged.cli.sweep.worker import Worker
from legged.commandline.arguments import pick_device
from legged.commandline.command import EXIT_FAILED, command
from legged.commandline.stopping import stopping_on_signals
from legged.config.checks import shown
from legged.errors import ConfigError
from legged.process.command_parser import CommandParser, add_import_argument
from legged.process.cores import available_cores
from legged.process.paths import ready_to_write, relative
from legged.process.ranks import Ranks
from legged.process.repeating import repeating
from legged.process.worker_pool import Job, Kind, WorkerPool, why_failed
from legged.registry import import_tasks
from legged.sweeping.plan import Plan, plan_sweep, read_sweep, sweep_file
from legged.sweeping.report import write_report
from legged.sweeping.study import WHY, Trials, check_installed, finished

TELL_S = 1.0
"""Interval at which the trials of other processes are read [s]."""
MOST_STARTS = 10
"""Largest number of restarts of a worker whose process ends before the sweep does."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged sweep run",
        __doc__,
        "legged sweep run anymal_c_flat",
        "legged sweep run cfg/sweeps/anymal_c_flat.yaml --trials 60 --jobs 4",
    )
    add_sweep_arguments(parser)
    parser.add_argument("--trials", type=int, help="trials in all, of all processes; those of the file by default")
    parser.add_argument("--jobs", type=int, help="processes side by side; one for each device by default")
    parser.add_argument("--worker", type=int, metavar="NUMBER", help=argparse.SUPPRESS)
    return parser


def add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that choose a sweep."""
    parser.add_argument("file", metavar="FILE", help="YAML file of the sweep, or the name of one in cfg/sweeps")
    parser.add_argument("--sim-device", help="cpu, cuda, or a list with commas, from which the jobs take theirs")
    parser.add_argument("--storage", help="URL of a database that several machines share, or journal:<file>")
    add_import_argument(parser)


def devices_of(args: argparse.Namespace) -> list[torch.device]:
    """Return the devices of --sim-device.

    Raises:
        ConfigError: there is no such device, or CPU and GPU are mixed.
    """
    devices = [pick_device(name) for name in args.sim_device.split(",")] if args.sim_device else [pick_device(None)]
    if len({device.type for device in devices}) > 1:
        raise ConfigError(f"--sim-device: {shown(args.sim_device)}: trials on a CPU and on a GPU can't be compared")
    return devices


def plan_of(args: argparse.Namespace, on_cpu: bool) -> Plan:
    """Return the plan of the sweep's file.

    Raises:
        ConfigError: optuna is missing, or the file is wrong.
    """
    check_installed()
    if args.module:
        import_tasks(args.module)
    path = sweep_file(args.file)
    return plan_sweep(read_sweep(path), path, on_cpu)


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    if Ranks.now().several:
        raise ConfigError("sweep: starts its processes by itself; run it without torchrun")
    for flag in ("jobs", "trials"):
        value = getattr(args, flag)
        if value is not None and value < 1:
            raise ConfigError(f"--{flag}: must be at least 1, got {value}")
    devices = devices_of(args)
    on_cpu = devices[0].type == "cpu"
    plan = plan_of(args, on_cpu)
    if args.trials is not None:
        plan = plan.with_trials(args.trials)
    ready_to_write(plan.folder)
    names = [str(device) for device in devices]
    if args.worker is not None:
        return _work(args, plan, names[0])
    trials = Trials(plan, args.storage or "")
    trials.keep_to(devices[0].type)
    jobs = args.jobs or len(devices)
    print(f"{plan.name}: {plan.given.trials} trials of {plan.cfg.task} for the {plan.objective_text}; {jobs} at once")
    own = plan.own
    beyond = [f"{path} {shown(own[path])}" for path, drawn in plan.own_drawn.items() if drawn is None]
    if beyond:
        print(f"no trial has the task's own settings, of which these are not among those tried: {', '.join(beyond)}")
    again = trials.take_back()
    if trials.all:
        numbers = f"; tried again: {', '.join(map(str, again))}" if again else ""
        print(
            f"going on in {relative(plan.folder)}: {trials.done} of {plan.given.trials} trials are done{numbers}", flush=True
        )
    if jobs == 1:
        worker = Worker(plan, trials, _flags(args, names[0], on_cpu, jobs))
        stopped_by = worker.run()
    else:
        stopped_by = _pool(args, trials, sweep_file(args.file), names, jobs)
    print(*write_report(trials, args.module), sep="\n")
    if stopped_by:
        return 128 + stopped_by[0]
    return 0 if trials.done >= plan.given.trials else EXIT_FAILED


def _work(args: argparse.Namespace, plan: Plan, device: str) -> int:
    """Run trials as one of several processes; return the exit code."""
    trials = Trials(plan, args.storage or "", args.worker)
    stopped_by = Worker(plan, trials, _flags(args, device, device == "cpu", args.jobs or 1)).run()
    return 128 + stopped_by[0] if stopped_by else 0


def _flags(args: argparse.Namespace, device: str, on_cpu: bool, jobs: int) -> list[str]:
    """Return the flags of train.py for the device and threads of a trial."""
    flags = ["--sim-device", device, *(["--import", args.module] if args.module else [])]
    return [*flags, f"sim.threads={max(1, available_cores() // jobs)}"] if on_cpu and jobs > 1 else flags


def _pool(args: argparse.Namespace, trials: Trials, path: Path, devices: list[str], jobs: int) -> list[int]:
    """Run trials in several processes; return the signals that ended processes early."""
    plan = trials.plan
    start, starts = time.perf_counter(), [0] * jobs
    pool = WorkerPool({Kind.TRAINING: jobs}, ())

    def job(number: int) -> Job:
        starts[number] += 1
        flags = ["--worker", str(number), "--jobs", str(jobs), "--sim-device", devices[number % len(devices)]]
        flags += ["--trials", str(plan.given.trials), *(["--storage", args.storage] if args.storage else [])]
        flags += ["--import", args.module] if args.module else []
        command = [sys.executable, "-m", "legged", "sweep", "run", str(path), *flags]
        return Job(
            Kind.TRAINING, command, plan.folder / "output" / f"worker{number}.txt", lambda *ended: done(number, *ended)
        )

    def done(number: int, ended: Job, code: int) -> list[Job]:
        if code == 0 or pool.stopped:
            return []
        say = f"{time.perf_counter() - start:7.1f} s  process {number} has ended: {why_failed(ended, code)}"
        again = code < 0 and starts[number] < MOST_STARTS
        print(f"{say}; {'another takes its place' if again else relative(ended.output)}", flush=True)
        return [job(number)] if again else []

    with stopping_on_signals(pool.stop) as stopped_by, repeating(_teller(trials, start), TELL_S, at_end=True):
        pool.run([job(number) for number in range(jobs)])
    return stopped_by


def _teller(trials: Trials, start: float) -> Callable[[], None]:
    """Return a function that prints, at each call, the trials of other processes that have ended since the last call."""
    told = {trial.number for trial in finished(trials.all)}

    def tell() -> None:
        for trial in finished(trials.all):
            if trial.number not in told:
                told.add(trial.number)
                what = trial.user_attrs.get(WHY) if trial.value is None else f"{trial.value:.4g}"
                counted = f"[{len(told)} of {trials.plan.given.trials}]"
                print(f"{time.perf_counter() - start:7.1f} s  trial {trial.number:3d}  {what}  {counted}", flush=True)

    return tell
