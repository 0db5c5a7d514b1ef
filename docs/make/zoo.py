"""Train and evaluate many tasks, and put them in one table: `python docs/make/zoo.py go2_flat h1_flat --seeds 1,2,3`.

Each task is trained with each seed (logs/<task>/<date_time>_s<seed>) and evaluated in each engine, in separate processes.
Their output is in logs/zoo/output/, the table in logs/zoo/table.md and table.json. The command skips finished runs of the
same configuration and evaluations of the same grid and terrain, so it continues where it was stopped. With --table it makes
the table of existing runs. With --ship it copies the policies as the package ships them.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from evaluated_run import EvaluatedRun, find_runs, results_in, why_unfinished
from run_table import markdown, summary
from shipping import ship

from legged.cli.evaluate import ROBOTS, check_points
from legged.commandline.arguments import pick_device
from legged.commandline.command import EXIT_FAILED, run_main, stopping_on_signals
from legged.config import LeggedConfig, override, parse_override
from legged.errors import ConfigError, suggest
from legged.evaluation.engines import ENGINES
from legged.evaluation.result_file import tracking_of
from legged.evaluation.success import TYPES_HELP, chosen_sizes
from legged.evaluation.velocity_grid import AXES, axes_of
from legged.learning.run_folder import CONFIG_FILE, checkpoints, experiment_folder, find_checkpoint, run_config
from legged.learning.timing import read_timing
from legged.process.command_parser import IMPORT, CommandParser
from legged.process.cores import available_cores
from legged.process.paths import make_folder, ready_to_write, relative, write_text
from legged.process.processes import Job, Kind, WorkerPool, why_failed
from legged.process.ranks import Ranks
from legged.registry import YAML_ENDINGS, import_tasks, register_file, task_config

OUT = Path("logs") / "zoo"
NEWTON = "newton_"
"""Prefix of the names of Newton's solvers in `ENGINES`."""
MOST_EVALUATIONS = 4
"""Largest number of evaluations that run at once on the GPU, and on the cores."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "zoo",
        __doc__,
        "python docs/make/zoo.py anymal_c_flat go2_flat h1_flat --seeds 1,2,3",
        "python docs/make/zoo.py --table logs --ship resources/policies",
    )
    parser.add_argument("tasks", nargs="*", metavar="TASK | key=value", help="tasks, and overrides for all of them")
    parser.add_argument("--seeds", default="1", help="random seeds, e.g. 1,2,3; 1 by default")
    parser.add_argument(
        "--jobs", type=int, default=1, help="trainings at the same time; with 1, the default, times are undisturbed"
    )
    parser.add_argument("--engines", default="mujoco_warp,mujoco", help="engines of the evaluations; mujoco_warp,mujoco")
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"robots per cell of the command grid; {ROBOTS}")
    parser.add_argument("--types", help=f"{TYPES_HELP}; for tasks with terrain")
    parser.add_argument("--full", action="store_true", help="all sizes of a terrain type, 256 robots each")
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a type; 32, or 256 with --full")
    parser.add_argument("--again", action="store_true", help="train finished runs again")
    IMPORT(parser)
    parser.add_argument("--sim-device", help="cpu or cuda[:i]; the GPU if there is one")
    parser.add_argument("--out", type=Path, help=f"folder for the table and the output of the processes; {OUT} by default")
    parser.add_argument("--ship", type=Path, help="folder to copy the policies to, e.g. resources/policies")
    parser.add_argument(
        "--table", nargs="+", type=Path, metavar="DIR", help="only make the table of the runs in these folders"
    )
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_intermixed_args(argv)
    if args.ship:
        ready_to_write(args.ship)
    if args.module:
        import_tasks(args.module)
    if args.table:
        if args.tasks:
            raise ConfigError(f"--table: trains nothing; leave out {args.tasks[0]}")
        _finish(find_runs(args.table), args.out, args.ship)
        return 0
    trainings = _plan(args)
    out = args.out or OUT
    ready_to_write(out)
    stopped_by = _Campaign(args, trainings, out).run()
    _finish([judged(training, args) for training in trainings], out, args.ship)
    failed = any(training.folder is None or training.notes for training in trainings)
    return 128 + stopped_by[0] if stopped_by else EXIT_FAILED if failed else 0


# ---- plan ------------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Training:
    """A task with a seed, and the state of its training."""

    given: str
    """The task's name or YAML file, as it was given."""
    seed: int
    cfg: LeggedConfig
    folder: Path | None = None
    """Run folder of the finished training; None before."""
    failure: str = ""
    notes: list[str] = field(default_factory=list)

    @property
    def label(self) -> str:
        """Task and seed, for messages."""
        return f"{self.cfg.task}, seed {self.seed}"

    @property
    def run(self) -> Path:
        """The folder of the finished run."""
        assert self.folder is not None, "the training comes first"
        return self.folder


def _plan(args: argparse.Namespace) -> list[Training]:
    """Check the arguments and return the trainings: the first seed of all tasks, then the second, and so on.

    Raises:
        ConfigError: an argument is wrong; nothing has been trained then.
    """
    if Ranks.now().several:
        raise ConfigError("zoo: run it without torchrun, because it starts its processes itself")
    for flag in ("jobs", "robots"):
        if getattr(args, flag) < 1:
            raise ConfigError(f"--{flag}: must be at least 1, got {getattr(args, flag)}")
    given = [text for text in args.tasks if "=" not in text]
    if not given:
        raise ConfigError("zoo: name the tasks to train, or folders of runs with --table")
    tasks = {text: register_file(text) if text.endswith(YAML_ENDINGS) else text for text in given}
    names = list(map(tasks.__getitem__, given))
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"zoo: '{name}' is named twice; name each task once")
    args.on_cpu = pick_device(args.sim_device).type == "cpu"
    args.overrides = ["train.runner.film=false", *(text for text in args.tasks if "=" in text)]
    args.engines = list(dict.fromkeys(name.strip() for name in args.engines.split(",")))
    for name in args.engines:
        if name not in ENGINES:
            raise ConfigError(f"--engines: there is no engine '{name}'{suggest(name, ENGINES)}")
    args.robots_per_point = check_points(args.robots_per_point, args.full)
    configs = {text: _config(task, args) for text, task in tasks.items()}
    return [Training(text, seed, _seeded(cfg, seed)) for seed in _seeds(args.seeds) for text, cfg in configs.items()]


def _config(task: str, args: argparse.Namespace) -> LeggedConfig:
    cfg = task_config(task, map(parse_override, args.overrides), args.on_cpu)
    if not isinstance(cfg, LeggedConfig):
        raise ConfigError(f"'{task}' follows no commands; the table has only tasks that do")
    axes_of(cfg)
    if cfg.terrain.mesh_type != "plane":
        chosen_sizes(cfg, args.types, args.full, cfg.terrain.scale)
    return cfg


def _seeded(cfg: LeggedConfig, seed: int) -> LeggedConfig:
    return override(cfg, [("env.seed", seed), ("train.runner.run_name", f"s{seed}")])  # type: ignore[return-value]


def _seeds(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise ConfigError(f"--seeds: '{text}' is not a list of whole numbers, like 1,2,3")
    numbers = [int(part) for part in parts]
    if len({*numbers}) < len(numbers):
        raise ConfigError(f"--seeds: '{text}' names a seed twice; name each seed once")
    return numbers


def finished_run(cfg: LeggedConfig) -> Path | None:
    """Return the newest finished run of this configuration; its evaluation, film and report settings may differ."""
    found = []
    for path in experiment_folder(cfg).glob(f"*_{cfg.train.runner.run_name}*/{CONFIG_FILE}"):
        try:
            trained = run_config(path.parent)
            if not isinstance(trained, LeggedConfig):
                continue
            runner = replace(trained.train.runner, film=cfg.train.runner.film, report=cfg.train.runner.report)
            shown_alike = replace(trained, evaluation=cfg.evaluation, train=replace(trained.train, runner=runner))
            if shown_alike == cfg and not why_unfinished(path.parent, cfg, read_timing(path.parent)):
                found.append(path.parent)
        except ConfigError:  # the run is damaged, or from another version
            continue
    return max(found, key=lambda folder: max(file.stat().st_mtime for file in checkpoints(folder).values()), default=None)


def missing_engines(training: Training, args: argparse.Namespace) -> list[str]:
    """Return the engines without an evaluation of the last checkpoint on the requested grid and terrain."""
    results = results_in(training.run)
    return [name for name in args.engines if not _is_measured(results.get(name), training, args)]


def _is_measured(result: dict[str, Any] | None, training: Training, args: argparse.Namespace) -> bool:
    if result is None or result.get("changes") or result.get("checkpoint") != find_checkpoint(training.run, None).name:
        return False
    cfg, tracking = training.cfg, tracking_of(result)
    if tracking.get("grid") != axes_of(cfg) or tracking.get("robots_per_cell") != args.robots:
        return False
    if cfg.terrain.mesh_type == "plane":
        return True
    success = result.get("success", {"types": {}})
    found = {name: {point["size"] for point in entry["points"]} for name, entry in success["types"].items()}
    wanted = chosen_sizes(cfg, args.types, args.full, cfg.terrain.scale)
    there = all({*sizes} <= found.get(name, set()) for name, sizes in wanted.items())
    return there and success.get("robots_per_point") == args.robots_per_point


def judged(training: Training, args: argparse.Namespace) -> EvaluatedRun:
    """Return a training with the evaluations that exist so far."""
    notes = tuple(training.notes)
    if training.folder is None:
        return EvaluatedRun(training.cfg, training.seed, failure=training.failure or "not trained yet", notes=notes)
    known = {*args.engines} - {*missing_engines(training, args)}
    results = {name: result for name, result in results_in(training.run).items() if name in known}
    return EvaluatedRun(training.cfg, training.seed, training.run, read_timing(training.run), results, notes=notes)


# ---- processes -------------------------------------------------------------------------------------------------------


def training_command(training: Training, args: argparse.Namespace) -> list[str]:
    """Return the command that trains."""
    named = [training.cfg.task, "--seed", str(training.seed), "--run-name", f"s{training.seed}"]
    return [*_program("train", training, args), *named, *_device(args), *args.overrides]


def evaluation_commands(training: Training, engine: str, args: argparse.Namespace, threads: int = 0) -> list[list[str]]:
    """Return the commands that evaluate a finished training in an engine of `ENGINES`: the grid and, for a task with terrain,
    the terrain. If `threads` is 0, C MuJoCo uses all cores.
    """
    solver = engine.removeprefix(NEWTON)
    common = ["--physics", engine] if solver == engine else ["--physics", "newton", "--solver", solver]
    common += [] if engine == "mujoco" else _device(args)
    common += [f"sim.threads={threads}"] if threads and not training.cfg.sim.threads else []
    trained, wanted = run_config(training.run), training.cfg.evaluation
    assert isinstance(trained, LeggedConfig), "finished_run found it"
    changed = [axis for axis in AXES if getattr(wanted, axis) != getattr(trained.evaluation, axis)]
    axes = [f"evaluation.{a}={list(getattr(wanted, a))}" for a in changed]
    run = str(training.run.resolve())
    grid = [*_program("evaluate grid", training, args), run, "--robots", str(args.robots), *common, *axes]
    if training.cfg.terrain.mesh_type == "plane":
        return [grid]
    points = ["--robots-per-point", str(args.robots_per_point)]
    points += [*(["--types", args.types] if args.types else []), *(["--full"] if args.full else [])]
    return [grid, [*_program("evaluate terrain", training, args), run, *points, *common, *axes]]


def _program(command: str, training: Training, args: argparse.Namespace) -> list[str]:
    """Return the words that call a command of `legged`, with the option that names user-defined tasks."""
    module = args.module or (training.given if training.given.endswith(YAML_ENDINGS) else None)
    return [sys.executable, "-m", "legged", *command.split(), *(["--import", module] if module else [])]


def _device(args: argparse.Namespace) -> list[str]:
    return ["--sim-device", args.sim_device] if args.sim_device else []


class _Campaign:
    """Trainings and evaluations in a pool of processes. The table is rewritten whenever one of them ends."""

    def __init__(self, args: argparse.Namespace, trainings: Sequence[Training], out: Path) -> None:
        self.args, self.trainings, self.out, self.start = args, trainings, out, time.perf_counter()
        cores = available_cores()
        free = cores if args.on_cpu else max(1, cores - args.jobs)  # a training on a GPU needs one core
        at_once = max(1, min(MOST_EVALUATIONS, free // 2))
        self.threads = max(1, free // at_once)
        shared = (Kind.ON_GPU, Kind.ON_CORES) if args.on_cpu else (Kind.ON_GPU,)
        room = {Kind.TRAINING: args.jobs, Kind.ON_GPU: at_once, Kind.ON_CORES: at_once}
        self.pool = WorkerPool(room, shared)

    def run(self) -> list[int]:
        """Train and evaluate; return the signals that ended the campaign early."""
        with stopping_on_signals(self.pool.stop) as stopped_by:
            self.pool.run([job for training in self.trainings for job in self._jobs(training)])
        return stopped_by

    def _jobs(self, training: Training) -> Iterator[Job]:
        training.folder = None if self.args.again else finished_run(training.cfg)
        if training.folder is None:
            command = training_command(training, self.args)
            yield self._job(Kind.TRAINING, command, training, "train", lambda job, code: self._trained(training, job, code))
        else:
            self._say(f"{training.label}: is in {relative(training.folder)} already")
            yield from self._evaluations(training)

    def _job(
        self, kind: Kind, command: list[str], training: Training, name: str, done: Callable[[Job, int], list[Job]]
    ) -> Job:
        return Job(kind, command, self.out / "output" / f"{training.cfg.task}_s{training.seed}_{name}.txt", done)

    def _trained(self, training: Training, job: Job, code: int) -> list[Job]:
        training.folder = finished_run(training.cfg) if code == 0 else None
        if training.folder is None:
            training.failure = self._why(job, code) if code else "there is no finished run of its configuration"
            self._say(f"{training.label}: training failed: {training.failure}; {relative(job.output)}")
            return self._written([])
        timing = read_timing(training.folder)
        assert timing is not None, "a finished training has written it"
        speed = f"{timing.loop_s:.1f} s, {timing.steps_per_s:,.0f} steps/s, start-up {timing.start_up_s:.1f} s"
        self._say(f"{training.label}: trained in {speed}; {relative(training.folder)}")
        return self._written([*self._evaluations(training)])

    def _evaluations(self, training: Training) -> Iterator[Job]:
        for engine in missing_engines(training, self.args):
            kind = Kind.ON_CORES if self.args.on_cpu or engine == "mujoco" else Kind.ON_GPU
            commands = evaluation_commands(training, engine, self.args, self.threads)
            yield self._evaluation(training, engine, kind, commands)

    def _evaluation(self, training: Training, engine: str, kind: Kind, commands: list[list[str]]) -> Job:
        """Return the job of the first command. When it ends, the jobs of the other commands follow."""
        first, *others = commands

        def done(job: Job, code: int) -> list[Job]:
            if not code and others:
                return [self._evaluation(training, engine, kind, others)]
            failure = f"evaluation in {engine} failed: {self._why(job, code)}" if code else ""
            training.notes += [failure] if code else []
            self._say(f"{training.label}: {f'{failure}; {relative(job.output)}' if code else f'evaluated in {engine}'}")
            return self._written([])

        return self._job(kind, first, training, f"{engine}_{len(commands)}" if others else engine, done)

    def _why(self, job: Job, code: int) -> str:
        return "stopped" if self.pool.stopped else why_failed(job, code)

    def _written(self, jobs: list[Job]) -> list[Job]:
        """Write the table of the results so far; return `jobs`."""
        _write_table([judged(training, self.args) for training in self.trainings], self.out)
        return jobs

    def _say(self, text: str) -> None:
        print(f"{time.perf_counter() - self.start:7.1f} s  {text}", flush=True)


# ---- table -----------------------------------------------------------------------------------------------------------


def _write_table(runs: Sequence[EvaluatedRun], out: Path) -> str:
    """Write table.md and table.json into a folder; return the Markdown."""
    tasks = summary(runs)
    text = markdown(tasks)
    make_folder(out)
    write_text(out / "table.md", text)
    write_text(out / "table.json", json.dumps({"torch": torch.__version__, "tasks": tasks}, indent=1, allow_nan=False) + "\n")
    return text


def _finish(runs: Sequence[EvaluatedRun], out: Path | None, shipped: Path | None) -> None:
    """Print the table, write it into `out`, and ship the policies to `shipped`, if these folders are given."""
    print(f"\n{markdown(summary(runs)) if out is None else _write_table(runs, out)}", end="", flush=True)
    if out is not None:
        print(f"\nwritten: {relative(out / 'table.md')}, {relative(out / 'table.json')}")
    if shipped is not None:
        print(*ship(runs, shipped), sep="\n")


if __name__ == "__main__":
    sys.exit(main())
