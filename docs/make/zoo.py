"""Train and evaluate tasks with several seeds: `python docs/make/zoo.py anymal_c go2 --seeds 1,2,3`.

Each training and each evaluation is a command of `legged` in a process of its own, one after the other, so that times are
undisturbed. Policies are evaluated in the engine of their training and in C MuJoCo. Finished runs of the same configuration
and their evaluations are kept, so the command continues where it was stopped. At the end it prints a table of the runs.

With --table the command only prints the table of existing runs. With --ship it copies the policies as the package ships them.
"""

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tables
from shipping import ship

from legged.cli.evaluate import ROBOTS, check_points
from legged.commandline.arguments import IMPORT, pick_device
from legged.commandline.command import EXIT_FAILED, run_main, stopping_on_signals
from legged.config import LeggedConfig, follows_velocities, parse_override, to_dict
from legged.config.dotted import differences
from legged.deploy.command_parser import CommandParser, check_number
from legged.errors import ConfigError
from legged.evaluation.engines import engine_of
from legged.evaluation.reports.record import NAMES, Record, folders_in, read_record
from legged.evaluation.result_file import changes_text, file_name, grid_text, has_tracking, tracking_of
from legged.evaluation.success import TYPES_HELP, chosen_sizes, types_in
from legged.evaluation.velocity_grid import axes_of
from legged.learning.run_folder import CONFIG_FILE, experiment_folder, run_config
from legged.physics import engine_name
from legged.process.paths import ready_to_write, relative
from legged.process.processes import child_environment
from legged.registry import import_tasks, task_config


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
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"robots per cell of the command grid; {ROBOTS}")
    parser.add_argument("--types", help=f"{TYPES_HELP}; for tasks with terrain")
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a terrain type; 32")
    IMPORT(parser)
    parser.add_argument("--ship", type=Path, help="folder to copy the policies to, e.g. resources/policies")
    parser.add_argument(
        "--table", nargs="+", type=Path, metavar="DIR", help="only print the table of the runs in these folders"
    )
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_intermixed_args(argv)
    if args.ship:
        ready_to_write(args.ship)
    if args.module:
        import_tasks(args.module)
    if args.table and args.tasks:
        raise ConfigError(f"--table: trains nothing; leave out {args.tasks[0]}")
    folders, failures = (args.table, []) if args.table else train_and_evaluate(args)
    runs = runs_in(folders)
    print(f"\n{table(runs)}", flush=True)
    if args.ship:
        print(*ship(runs, args.ship), sep="\n", flush=True)
    for failure in failures:
        print(f"failed: {failure}", file=sys.stderr)
    return EXIT_FAILED if failures else 0


# ---- trainings and evaluations ---------------------------------------------------------------------------------------


class Training(NamedTuple):
    """A task with a seed, and the evaluations of its policy."""

    cfg: LeggedConfig
    engines: list[str]
    grid: dict[str, list[float]]
    """Values of vx, vy [m/s] and yaw rate [rad/s]."""
    sizes: dict[str, tuple[float, ...]]
    """Terrain type -> sizes; empty for a task on a plane."""


def train_and_evaluate(args: argparse.Namespace) -> tuple[list[Path], list[str]]:
    """Train and evaluate the tasks of the command line. Return the folders of the runs, and a text about each failure.

    Raises:
        ConfigError: an argument is wrong; nothing has been trained then.
    """
    folders, failures = [], []
    for training in plan(args):
        cfg, seed = training.cfg, str(training.cfg.env.seed)
        run = finished_run(cfg)
        if run is None:
            legged("train", cfg.task, "--seed", seed, "--run-name", f"s{seed}", *imports(args), *overrides(args))
            run = finished_run(cfg)
        if run is None:
            failures.append(f"{cfg.task}, seed {seed}: training")
            continue
        folders.append(run.folder)
        for words in missing_evaluations(run, training, args):
            if legged("evaluate", *words, *imports(args)) != 0:
                failures.append(f"{cfg.task}, seed {seed}: legged evaluate {shlex.join(words)}")
    return folders, failures


def plan(args: argparse.Namespace) -> list[Training]:
    """Check the arguments and return the trainings: the first seed of all tasks, then the second, and so on.

    Raises:
        ConfigError: an argument is wrong.
    """
    check_number("--robots", args.robots, 1)
    args.robots_per_point = check_points(args.robots_per_point, full=False)
    names = dict.fromkeys(text for text in args.tasks if "=" not in text)
    if not names:
        raise ConfigError("zoo: name the tasks to train, or folders of runs with --table")
    seeds = [part.strip() for part in args.seeds.split(",")]
    if not all(map(str.isdecimal, seeds)):
        raise ConfigError(f"--seeds: '{args.seeds}' is not a list of whole numbers, like 1,2,3")
    device, trainings = pick_device(None), []
    for seed in dict.fromkeys(map(int, seeds)):
        for name in names:
            changes = [*map(parse_override, overrides(args)), ("env.seed", seed)]
            cfg = task_config(name, changes, on_cpu=device.type == "cpu")
            if not follows_velocities(cfg):
                raise ConfigError(f"'{name}' follows no commands; the table has only tasks that do")
            own = engine_name(cfg.sim, device, num_envs=cfg.env.num_envs)
            flat = cfg.terrain.mesh_type == "plane"
            sizes = {} if flat else chosen_sizes(cfg, args.types, False, cfg.terrain.scale)
            trainings.append(Training(cfg, [*dict.fromkeys((own, "mujoco"))], axes_of(cfg), sizes))
    return trainings


def overrides(args: argparse.Namespace) -> list[str]:
    """Return the overrides of all trainings."""
    return ["train.runner.film=false", *(text for text in args.tasks if "=" in text)]


def imports(args: argparse.Namespace) -> list[str]:
    """Return the option of `legged` that names the user-defined tasks."""
    return ["--import", args.module] if args.module else []


def finished_run(cfg: LeggedConfig) -> Record | None:
    """Return the newest finished run of a configuration; its settings of evaluations, film and report may differ."""
    for path in sorted(experiment_folder(cfg).glob(f"*_s{cfg.env.seed}*/{CONFIG_FILE}"), reverse=True):
        run = read_record(path.parent)
        others = {name for name in differences([run.config, to_dict(cfg)]) if not name.startswith("evaluation.")}
        if run.status == "finished" and others <= {*NAMES}:
            return run
    return None


def missing_evaluations(run: Record, training: Training, args: argparse.Namespace) -> Iterator[list[str]]:
    """Yield the words after `legged evaluate` for each evaluation that a run lacks: its grid of commands, and its terrain."""
    asked = {f"evaluation.{axis}": list(getattr(training.cfg.evaluation, axis)) for axis in training.grid}
    changes = [f"{name}={values}" for name, values in asked.items() if run.at(name) != values]
    for engine in training.engines:
        result = run.results.get(engine, {})
        known = {} if why_left_out(run, result) else result
        # Without --physics, a policy that was trained in Newton is evaluated in Newton, with the same solver.
        common = [str(run.folder), *([] if engine.startswith("newton") else ["--physics", engine]), *changes]
        tracking, success = tracking_of(known), known.get("success", {})
        if (tracking.get("grid"), tracking.get("robots_per_cell")) != (training.grid, args.robots):
            yield ["grid", *common, "--robots", str(args.robots)]
        there = types_in(known) if success.get("robots_per_point") == args.robots_per_point else {}
        points = {name: {point["size"] for point in entry["points"]} for name, entry in there.items()}
        if any({*sizes} - points.get(name, set()) for name, sizes in training.sizes.items()):
            types = ["--types", args.types] if args.types else []
            yield ["terrain", *common, *types, "--robots-per-point", str(args.robots_per_point)]


def legged(*words: str) -> int:
    """Run a command of `legged` and return its exit code. A signal ends the command, and then this process."""
    print(f"\n$ legged {shlex.join(words)}", flush=True)
    command = [sys.executable, "-m", "legged", *words]
    with (
        subprocess.Popen(command, env=child_environment(), start_new_session=True) as process,
        stopping_on_signals(process.terminate) as stopped_by,
    ):
        code = process.wait()
    if stopped_by:
        raise SystemExit(128 + stopped_by[0])
    return code


# ---- runs and their table --------------------------------------------------------------------------------------------


def runs_in(folders: Iterable[Path]) -> list[Record]:
    """Return the finished runs in some folders, with the evaluations of their last policies. A printed line names each run
    and each evaluation that is left out, with the reason, and each evaluation on another grid than the task's.

    Raises:
        ConfigError: a folder holds no run.
    """
    found = []
    for folder in {path.resolve(): path for given in folders for path in folders_in(given)}.values():
        run = read_record(folder)
        why = "; ".join(run.problems) or ("" if run.status == "finished" else f"{run.status} {run.why}")
        if not why and "commands" not in run.config:
            why = f"'{run.task}' follows no commands"
        if why:
            _warn("left out", folder, why)
            continue
        for engine, result in [*run.results.items()]:
            path, grid = folder / file_name(engine), tracking_of(result).get("grid")
            if why := why_left_out(run, result):
                _warn("left out", path, why)
                del run.results[engine]
            elif grid not in (None, axes_of(run_config(folder))):  # type: ignore[arg-type]
                _warn("note", path, f"is not on the task's grid of commands, but on {grid_text(result)}")
        found.append(run)
    return found


def _warn(what: str, path: Path, why: str) -> None:
    print(f"{what}: {relative(path)}: {why}", file=sys.stderr, flush=True)


def why_left_out(run: Record, result: dict[str, Any]) -> str:
    """Return why an evaluation does not describe the policy of a run; an empty text if it does."""
    other, changes = run.another_policy(result), changes_text(result)
    return f"is of {other}, not of the last policy" if other else f"was made with {changes}" if changes else ""


def table(runs: Sequence[Record]) -> str:
    """Return a Markdown table in the columns of the pages' tables, with a line for each evaluation. Below it are the mean
    velocity errors over the seeds.
    """
    rows: list[list[str]] = []
    velocities: dict[str, list[float]] = {}
    for run in runs:
        head = [run.task, str(run.at("env.seed")), *tables.training(run.folder)]
        rows += [] if run.results else [[*head, "not evaluated"]]
        for engine, result in run.results.items():
            label = engine_of(engine).label
            errors = tables.errors(result) if has_tracking(result) else ["-"] * len(tables.ERRORS)
            rows.append([*head, label, *errors, *tables.crossings(result)])
            if has_tracking(result) and (error := tracking_of(result)["rmse_lin"]["mean"]) is not None:
                velocities.setdefault(f"{run.task}, {label}", []).append(error)
    heads = ("task", "seed", *tables.TRAINING, "engine", *tables.ERRORS, *tables.CROSSINGS)
    means = [
        f"- {name}: velocity RMSE {tables.over_seeds(found)} m/s" for name, found in velocities.items() if len(found) > 1
    ]
    text = tables.table(heads, [[*row, *[""] * (len(heads) - len(row))] for row in rows])
    return "\n".join([text, *(["", "Mean of the seeds (lowest to highest):", *means] if means else [])])


if __name__ == "__main__":
    sys.exit(main())
