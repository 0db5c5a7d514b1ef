"""Many tasks, trained, judged and in one table: `python -m legged.tools.zoo go2_flat h1_flat --seeds 1,2,3`.

For every task and seed it trains (logs/<task>/<date_time>_s<seed>), then judges the policy in mujoco-warp and in C MuJoCo as
evaluate does, each in a process of its own. What they print is in logs/zoo/output/; the table is logs/zoo/table.md, with all
its numbers in table.json. A run that is there and has finished, with the same configuration, is not trained again, so the
command goes on where it was stopped. A training that fails is a line in the table.

With --table it only makes the table, of the runs in some folders, and with --ship it copies the policies as this package
ships them.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from legged.commandline.arguments import pick_device
from legged.commandline.command import EXIT_FAILED, run_main
from legged.commandline.parser import CommandParser, add_import_argument
from legged.commandline.stopping import stopping_on_signals
from legged.errors import ConfigError
from legged.evaluation.evaluated_run import EvaluatedRun, find_runs
from legged.evaluation.run_table import markdown, summary
from legged.evaluation.success import TYPES_HELP
from legged.learning.timing import read_timing
from legged.process.cores import available_cores
from legged.process.paths import make_folder, ready_to_write, relative, write_text
from legged.process.ranks import Ranks
from legged.registry import YAML_ENDINGS, import_tasks, register_file
from legged.tools.campaign.crew import Crew, Job, Kind, why_failed
from legged.tools.campaign.plan import (
    Order,
    Training,
    evaluation_command,
    finished_run,
    known_engines,
    missing_engines,
    seeds_in,
    training_command,
    trainings_of,
)
from legged.tools.campaign.shipping import ship
from legged.tools.evaluate import ROBOTS, check_points

OUT = Path("logs") / "zoo"
VANISHED = "it ended, and there is no finished run of its configuration"
MOST_EVALUATIONS = 4
"""Evaluations of a kind side by side, if nobody says how many."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "zoo",
        __doc__,
        "python -m legged.tools.zoo anymal_c_flat go2_flat h1_flat --seeds 1,2,3",
        "python -m legged.tools.zoo --table logs --ship resources/policies",
    )
    parser.add_argument("tasks", nargs="*", metavar="TASK | key=value", help="tasks, and any field of all of them")
    parser.add_argument("--seeds", default="1", help="random seeds, e.g. 1,2,3; 1 by default")
    parser.add_argument("--jobs", type=int, default=1, help="trainings side by side; 1, so that their times are their own")
    parser.add_argument("--evaluations", type=int, help=f"evaluations side by side, of a kind; at most {MOST_EVALUATIONS}")
    parser.add_argument("--engines", default="mujoco_warp,mujoco", help="engines to judge in; mujoco_warp,mujoco by default")
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"robots a cell of the command grid; {ROBOTS}")
    parser.add_argument("--types", help=f"{TYPES_HELP}; for tasks with terrain")
    parser.add_argument("--full", action="store_true", help="all sizes of a terrain type, 256 robots each")
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a type; 32, or 256 with --full")
    parser.add_argument("--again", action="store_true", help="train also what has been trained")
    add_import_argument(parser)
    parser.add_argument("--sim_device", help="cpu or cuda[:i]; the GPU if there is one")
    parser.add_argument("--out", type=Path, help=f"folder for the table and what the processes print; {OUT} by default")
    parser.add_argument("--ship", type=Path, help="folder to copy the policies to, e.g. resources/policies")
    parser.add_argument(
        "--table", nargs="+", type=Path, metavar="DIR", help="make the table of the runs in these folders, only"
    )
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_intermixed_args(argv)
    if args.ship:
        ready_to_write(args.ship)
    if args.table:
        if args.tasks:
            raise ConfigError(f"--table: trains nothing; leave out {args.tasks[0]}")
        if args.module:
            import_tasks(args.module)
        _finish(find_runs(args.table), args.out, args.ship)
        return 0
    trainings, order = _plan(args)
    out = args.out or OUT
    ready_to_write(out)
    stopped_by = _Campaign(args, trainings, order, out).run()
    _finish([training.judged(order) for training in trainings], out, args.ship)
    failed = any(training.folder is None or training.notes for training in trainings)
    return 128 + stopped_by[0] if stopped_by else EXIT_FAILED if failed else 0


def _plan(args: argparse.Namespace) -> tuple[list[Training], Order]:
    """Return what is to be trained, and how each is judged.

    Raises:
        ConfigError: something that was asked for can't be; nothing has been trained then.
    """
    if Ranks.now().several:
        raise ConfigError("zoo: starts its processes by itself; run it without torchrun")
    for flag in ("jobs", "evaluations", "robots"):
        value = getattr(args, flag)
        if value is not None and value < 1:
            raise ConfigError(f"--{flag}: must be at least 1, got {value}")
    if args.module:
        import_tasks(args.module)
    given = [text for text in args.tasks if "=" not in text]
    if not given:
        raise ConfigError("zoo: name the tasks to train, or folders of runs with --table")
    tasks = [(text, register_file(text) if text.endswith(YAML_ENDINGS) else text) for text in given]
    names = [name for _, name in tasks]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"zoo: '{name}' is named twice; each task may come once")
    on_cpu = pick_device(args.sim_device).type == "cpu"
    order = Order(
        overrides=("train.runner.film=false", *(text for text in args.tasks if "=" in text)),
        module=args.module,
        sim_device=args.sim_device,
        on_cpu=on_cpu,
        engines=known_engines(args.engines),
        robots=args.robots,
        types=args.types,
        full=args.full,
        robots_per_point=check_points(args.robots_per_point, args.full),
    )
    return trainings_of(tasks, seeds_in(args.seeds), order), order


class _Campaign:
    """Trainings and evaluations on their way; the table is written anew whenever one has ended."""

    def __init__(self, args: argparse.Namespace, trainings: Sequence[Training], order: Order, out: Path) -> None:
        self.trainings, self.out, self.start = trainings, out, time.perf_counter()
        cores = available_cores()
        # On a GPU the cores are free but for one a training; without one they train.
        free = cores if order.on_cpu else max(1, cores - args.jobs)
        side_by_side = args.evaluations or max(1, min(MOST_EVALUATIONS, free // 2))
        self.order = replace(order, threads=max(1, free // side_by_side))
        room = {Kind.TRAINING: args.jobs, Kind.ON_GPU: side_by_side, Kind.ON_CORES: side_by_side}
        shared = (Kind.ON_GPU, Kind.ON_CORES) if order.on_cpu else (Kind.ON_GPU,)
        self.crew = Crew(room, shared)
        self.jobs: list[Job] = []
        for training in trainings:
            training.folder = None if args.again else finished_run(training.cfg)
            if training.folder is None:
                self.jobs.append(self._training(training))
            else:
                self._say(f"{training.label}: is in {relative(training.folder)} already")
                self.jobs += self._evaluations(training)

    def run(self) -> list[int]:
        """Train and judge; return the signals that ended it early."""
        with stopping_on_signals(self.crew.stop) as stopped_by:
            self.crew.run(self.jobs)
        return stopped_by

    def _training(self, training: Training) -> Job:
        def done(job: Job, code: int) -> list[Job]:
            training.folder = finished_run(training.cfg) if code == 0 else None
            if training.folder is None:
                training.failure = "stopped" if self.crew.stopped else why_failed(job, code) if code else VANISHED
                self._say(f"{training.label}: training failed: {training.failure}; {relative(job.output)}")
                return self._written([])
            timing = read_timing(training.folder)
            assert timing is not None, "it has just been written"
            speed = f"{timing.loop_s:.1f} s, {timing.steps_per_s:,.0f} steps/s, start-up {timing.start_up_s:.1f} s"
            self._say(f"{training.label}: trained in {speed}; {relative(training.folder)}")
            return self._written(self._evaluations(training))

        return Job(Kind.TRAINING, training_command(training, self.order), self._output(training, "train"), done)

    def _evaluations(self, training: Training) -> list[Job]:
        return [self._evaluation(training, engine) for engine in missing_engines(training, self.order)]

    def _evaluation(self, training: Training, engine: str) -> Job:
        def done(job: Job, code: int) -> list[Job]:
            if code:
                why = "stopped" if self.crew.stopped else why_failed(job, code)
                training.notes.append(f"evaluation in {engine} failed: {why}")
                self._say(f"{training.label}: {training.notes[-1]}; {relative(job.output)}")
            else:
                self._say(f"{training.label}: judged in {engine}")
            return self._written([])

        kind = Kind.ON_CORES if self.order.on_cpu or engine == "mujoco" else Kind.ON_GPU
        return Job(kind, evaluation_command(training, engine, self.order), self._output(training, engine), done)

    def _output(self, training: Training, what: str) -> Path:
        return self.out / "output" / f"{training.stem}_{what}.txt"

    def _written(self, jobs: list[Job]) -> list[Job]:
        """Write the table as far as it goes; return `jobs`."""
        _write_table([training.judged(self.order) for training in self.trainings], self.out)
        return jobs

    def _say(self, text: str) -> None:
        print(f"{time.perf_counter() - self.start:7.1f} s  {text}", flush=True)


def _write_table(runs: Sequence[EvaluatedRun], out: Path) -> str:
    """Write table.md and table.json into a folder; return the first."""
    tasks = summary(runs)
    text = markdown(tasks)
    make_folder(out)
    write_text(out / "table.md", text)
    write_text(out / "table.json", json.dumps({"torch": torch.__version__, "tasks": tasks}, indent=1, allow_nan=False) + "\n")
    return text


def _finish(runs: Sequence[EvaluatedRun], out: Path | None, shipped: Path | None) -> None:
    """Print the table, write it if there is a folder for it, and ship the policies if there is one for them."""
    print(f"\n{markdown(summary(runs)) if out is None else _write_table(runs, out)}", end="", flush=True)
    if out is not None:
        print(f"\nwritten: {relative(out / 'table.md')}, {relative(out / 'table.json')}")
    if shipped is not None:
        print(*ship(runs, shipped), sep="\n")


if __name__ == "__main__":
    sys.exit(main())
