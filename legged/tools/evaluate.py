"""How good a policy is: `python -m legged.tools.evaluate --task anymal_c_flat [--physics mujoco]`.

Of robots that follow commands: how well they do, for tasks with terrain on rough ground, and how hard a terrain they still
cross. Prints tables and writes evaluation_<physics>.json and .png and success_<physics>.png beside the checkpoint (or to
--out). With `--physics all`, the same commands in every engine and solver: crossing.json and .png. With `--all-checkpoints`,
all checkpoints of a run on the grid, and when the first of them walked: time_to_walk.json; seconds are counted from the start
of the process that wrote the checkpoint, and a small train.runner.save_interval makes them finer. With `--stress`, a table of
disturbances on stairs and on the flat, ground that nobody trains on, and other solvers: stress_<physics>.json and .png.

Of all other tasks: returns and lengths of full episodes, in evaluation_<physics>.json. With `--gymnasium`, of the exported
policy in Gymnasium's own environment, as Gymnasium counts them.
"""

import argparse
import sys
from pathlib import Path

import torch

from legged.commandline.arguments import (
    add_run_arguments,
    add_task_arguments,
    pick_device,
    policy_overrides,
    register_given,
    settle_on,
)
from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser
from legged.config import LeggedConfig, override
from legged.envs import LeggedRobot
from legged.errors import ConfigError, suggest
from legged.evaluation.all_checkpoints import WALKING_FALLS, WALKING_RMSE, check_limits, evaluate_all_checkpoints
from legged.evaluation.crossing import EVERYWHERE, cross
from legged.evaluation.episodes import MOST_EPISODES, evaluate_episodes
from legged.evaluation.following import evaluate_following
from legged.evaluation.gymnasium_episodes import EPISODES, environment_of, evaluate_in_gymnasium
from legged.evaluation.result_file import CHANGED, changes_of
from legged.evaluation.stress.measuring import RISER, TREAD, Wish
from legged.evaluation.stress.report import evaluate_stress
from legged.evaluation.stress.table import NAMES
from legged.evaluation.success import TYPES_HELP, chosen_sizes
from legged.evaluation.velocity_grid import AXES, MOST_ROBOTS, Grid, axes_of, axis_values, check_size
from legged.physics import resolve_physics
from legged.policies.restore import TrainedPolicy, find_policy
from legged.process.paths import ready_to_write
from legged.registry import task_class

MOST_SIZES = 16
"""Sizes of a terrain type, at most, that are measured at once."""
ROBOTS = 16
"""Robots a cell, if nobody says how many."""
ENVIRONMENTS = 256
"""Episodes, each of an environment of its own, if nobody says how many."""
OF_STRESS = ("riser", "tread", "payload", "lines")
"""Flags of --stress."""
OF_COMMANDS = (
    *AXES,
    "robots",
    "types",
    "full",
    "robots_per_point",
    "all_checkpoints",
    "rmse",
    "falls",
    "stress",
    *OF_STRESS,
)
"""Flags of tasks that follow commands."""
STRESS_LIMITS = {"riser": (0.0, 1.0, "m"), "tread": (0.05, 2.0, "m"), "payload": (0.0, 1000.0, "kg")}
"""Flag -> smallest and largest number, and its unit."""
OF_EPISODES = ("episodes", "gymnasium")
"""Flags of other tasks."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "evaluate",
        __doc__,
        "python -m legged.tools.evaluate --task anymal_c --physics mujoco",
        "python -m legged.tools.evaluate --task anymal_c --stress --physics mujoco",
        "python -m legged.tools.evaluate --task half_cheetah --gymnasium --episodes 20",
    )
    add_task_arguments(parser)
    add_run_arguments(parser)
    for axis, unit in AXES.items():
        parser.add_argument(f"--{axis}", help=f"low:high:step of the command grid [{unit}]; evaluation.{axis} by default")
    parser.add_argument("--robots", type=int, help=f"robots a cell; {ROBOTS}")
    parser.add_argument("--types", help=TYPES_HELP)
    parser.add_argument(
        "--full", action="store_true", help="all sizes of a type, or all lines with every solver; 256 robots each"
    )
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a type; 32, or 256 with --full")
    parser.add_argument("--all-checkpoints", action="store_true", help="which checkpoint of a run is the first that walks")
    parser.add_argument("--rmse", type=float, help=f"a robot that walks has a smaller velocity RMSE [m/s]; {WALKING_RMSE}")
    parser.add_argument("--falls", type=float, help=f"and a smaller share of falls; {WALKING_FALLS}")
    parser.add_argument(
        "--stress", action="store_true", help="what disturbances, unknown ground and other solvers leave of it"
    )
    parser.add_argument(
        "--riser", type=float, help=f"height of the steps of --stress [m]; {RISER} for a robot half a metre high"
    )
    parser.add_argument("--tread", type=float, help=f"their width [m]; {TREAD}")
    parser.add_argument(
        "--payload", type=float, help="mass on the base in --stress [kg]; 8 kg for an ANYmal C, for others like it"
    )
    parser.add_argument("--lines", help="lines of --stress to measure, e.g. 'nominal,payload,together'; all, and a score")
    many = f"of a task without commands; {ENVIRONMENTS}, {EPISODES} with --gymnasium"
    parser.add_argument("--episodes", type=int, help=many)
    parser.add_argument("--gymnasium", action="store_true", help="the exported policy in Gymnasium's environment")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for JSON and PNG; by default beside the checkpoint, or logs/evaluate for a shipped one, and changed/ in "
        "it if fields are changed",
    )
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_intermixed_args(argv)
    register_given(args)
    if issubclass(task_class(args.task), LeggedRobot):
        return _follow_commands(args)
    return _run_episodes(args)


def _refuse(args: argparse.Namespace, flags: tuple[str, ...], why: str) -> None:
    """Raise a ConfigError if one of the flags was given."""
    for flag in flags:
        value = getattr(args, flag)
        if value is not None and value is not False:
            raise ConfigError(f"--{flag.replace('_', '-')}: {why}")


def _device(args: argparse.Namespace) -> torch.device:
    """Return the device to measure on, and set torch up for it."""
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    return device


def check_points(given: int | None, full: bool) -> int:
    """Return the robots for each size of a terrain type: those `given` by --robots-per-point, or the usual number.

    Raises:
        ConfigError: they are none, or more than any machine holds.
    """
    a_point = given if given is not None else (256 if full else 32)
    if not 1 <= a_point <= MOST_ROBOTS // MOST_SIZES:
        limit = "at least 1" if a_point < 1 else f"at most {MOST_ROBOTS // MOST_SIZES:,}"
        raise ConfigError(f"--robots-per-point: must be {limit}, got {a_point:,}")
    return a_point


def _follow_commands(args: argparse.Namespace) -> int:
    """Evaluate a task whose robots follow commands; return the exit code."""
    _refuse(args, OF_EPISODES, f"'{args.task}' follows commands; it is measured by how well")
    if args.num_envs is not None:
        raise ConfigError("--num_envs: the grid says how many robots there are; --robots sets those of a cell")
    texts = {axis: getattr(args, axis) for axis in AXES}
    given = {axis: axis_values(f"--{axis}", text) for axis, text in texts.items() if text is not None}
    a_point = check_points(args.robots_per_point, args.full)
    everywhere = args.physics == EVERYWHERE
    if args.all_checkpoints:
        _refuse(args, ("checkpoint", "types"), "--all-checkpoints tracks commands with every checkpoint; leave it out")
        if everywhere:
            raise ConfigError(f"--all-checkpoints: looks at one engine; leave out --physics {EVERYWHERE}")
    else:
        _refuse(args, ("rmse", "falls"), "is a limit of --all-checkpoints; add it")
    _check_stress(args)
    rmse = WALKING_RMSE if args.rmse is None else args.rmse
    falls = WALKING_FALLS if args.falls is None else args.falls
    check_limits(rmse, falls)
    device = _device(args)
    if everywhere:
        only = f"--physics {EVERYWHERE} tracks commands in every solver, only"
        _refuse(args, ("solver", "types", "robots_per_point"), only)
        args.physics = None
    policy = find_policy(args)
    judged: LeggedConfig = override(policy.cfg, policy_overrides(args))  # type: ignore[assignment]
    axes = {**axes_of(judged), **given}
    grid = Grid(axes["vx"], axes["vy"], axes["yaw"], ROBOTS if args.robots is None else args.robots)
    check_size(grid)
    folder, graph = _folder(args, policy), not args.no_graph
    ready_to_write(folder)
    if everywhere:
        return cross(policy, grid, policy_overrides(args), device, graph, folder)
    # The engine is that of the device, not that of the training.
    asked = [("sim.physics", resolve_physics("auto", device)), *policy_overrides(args)]
    where = "--physics" if args.physics else "sim.physics"
    if args.stress:
        wish = Wish(args.riser, TREAD if args.tread is None else args.tread, args.payload, stress_lines(args.lines))
        return evaluate_stress(policy, a_point, args.full, wish, asked, device, graph, folder, where)
    if args.all_checkpoints:
        return evaluate_all_checkpoints(policy, grid, asked, device, graph, folder, rmse, falls)
    sizes = chosen_sizes(policy.cfg, args.types, args.full, judged.terrain.scale)  # type: ignore[arg-type]
    return evaluate_following(policy, grid, sizes, a_point, asked, device, graph, folder, where)


def _folder(args: argparse.Namespace, policy: TrainedPolicy) -> Path:
    """Return where files go. Where fields are changed they are not the policy's own results, and do not take their place."""
    own = policy.output("evaluate")
    return args.out or (own / CHANGED if changes_of(policy_overrides(args)) else own)


def _check_stress(args: argparse.Namespace) -> None:
    """Look whether the flags fit --stress, or its absence.

    Raises:
        ConfigError: one of them does not.
    """
    if not args.stress:
        _refuse(args, OF_STRESS, "is of --stress; add it")
        return
    stress_lines(args.lines)
    own = "--stress has a table of its own; leave it out"
    _refuse(args, (*AXES, "robots", "types", "all_checkpoints"), own)
    if args.physics == EVERYWHERE:
        raise ConfigError(f"--stress: looks at one engine; leave out --physics {EVERYWHERE}")
    for flag, (low, high, unit) in STRESS_LIMITS.items():
        value = getattr(args, flag)
        if value is not None and not low <= value <= high:
            raise ConfigError(f"--{flag}: must be between {low:g} and {high:g} {unit}, got {value:g}")


def stress_lines(text: str | None) -> tuple[str, ...]:
    """Return the names of lines in the comma-separated list of --lines.

    Raises:
        ConfigError: there is no such line.
    """
    names = tuple(name.strip() for name in text.split(",")) if text is not None else ()
    for name in names:
        if name not in NAMES:
            raise ConfigError(f"--lines: there is no line '{name}'{suggest(name, NAMES)}")
    return names


def _run_episodes(args: argparse.Namespace) -> int:
    """Evaluate a task without commands; return the exit code."""
    _refuse(args, OF_COMMANDS, f"'{args.task}' follows no commands; --episodes says how long it is measured")
    if args.num_envs is not None:
        raise ConfigError("--num_envs: every episode has a robot of its own; --episodes says how many")
    episodes = args.episodes if args.episodes is not None else EPISODES if args.gymnasium else ENVIRONMENTS
    if not 1 <= episodes <= MOST_EPISODES:
        limit = "at least 1" if episodes < 1 else f"at most {MOST_EPISODES:,}"
        raise ConfigError(f"--episodes: must be {limit}, got {episodes:,}")
    if args.physics == EVERYWHERE:
        raise ConfigError(f"--physics: '{EVERYWHERE}' is for tasks that follow commands; name one engine")
    if args.gymnasium:
        environment_of(args.task)
        _refuse(args, ("physics", "solver", "sim_device"), "Gymnasium simulates by itself; leave it out")
    device = _device(args)
    policy = find_policy(args)
    folder = _folder(args, policy)
    ready_to_write(folder)
    if args.gymnasium:
        return evaluate_in_gymnasium(policy, episodes, policy_overrides(args), folder)
    asked = [("sim.physics", resolve_physics("auto", device)), *policy_overrides(args)]
    where = "--physics" if args.physics else "sim.physics"
    return evaluate_episodes(policy, episodes, asked, device, not args.no_graph, folder, where)


if __name__ == "__main__":
    sys.exit(main())
