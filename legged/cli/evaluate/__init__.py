"""`legged evaluate`: measurements of policies."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from legged.cli.main import hint_at_sub_command
from legged.commandline.arguments import POLICY, measuring_device, policy_overrides, register_given, velocity_command
from legged.commandline.command import sub_command
from legged.config import follows_velocities
from legged.config.tracking import tracks_motions
from legged.deploy.command_parser import Argument, argument, check_between, check_number
from legged.errors import ConfigError, suggest
from legged.evaluation.episodes import MOST_EPISODES, evaluate_episodes, evaluate_in_gymnasium
from legged.evaluation.following import (
    EVERYWHERE,
    WALKING_FALLS,
    WALKING_RMSE,
    cross,
    evaluate_all_checkpoints,
    evaluate_following,
)
from legged.evaluation.measurement import Setting
from legged.evaluation.motions import SUCCESS_S, evaluate_motions, motions_table
from legged.evaluation.playback import SETTLING_S, follow, play
from legged.evaluation.result_file import CHANGED, changes_of
from legged.evaluation.stress.disturbances import NAMES
from legged.evaluation.stress.measuring import RISER, TREAD, Bench, evaluate_stress
from legged.evaluation.success import TYPES_HELP, chosen_sizes
from legged.evaluation.trackers import Tracker
from legged.evaluation.velocity_grid import AXES, AXIS, MOST_ROBOTS, Grid, axes_of, axis_values, check_size
from legged.learning.run_folder import CONFIG_FILE
from legged.policies.foreign import ForeignPolicy, Layout, read_layout, was_trained_with_other_motors
from legged.policies.restore import policy_of
from legged.process.paths import exists, make_folder, ready_to_write, relative, write_text
from legged.robots.robot import Robot, load_robot
from legged.tables import screen_table

ROBOTS = 16
"""Default number of robots that follow each command of a grid."""
MOST_SIZES = 16
"""Number of terrain sizes that can be simulated at once with the largest allowed value of --robots-per-point."""
ENVIRONMENTS = 256
"""Default number of episodes; each runs in a separate environment."""
STARTS = 1024
"""Default number of episodes of each motion."""
IN_GYMNASIUM = 20
"""Default number of episodes in Gymnasium's environment."""
EVALUATED = (
    *POLICY,
    argument(
        "--out",
        type=Path,
        help="folder for JSON and PNG files; by default the run folder, or logs/evaluate/<task> for a shipped policy (with"
        " overridden settings: the subfolder changed/ of this folder)",
    ),
)
"""Arguments of all commands that evaluate a checkpoint."""
GRID = (
    *(
        argument(f"--{axis}", help=f"{axis} in the grid, low:high:step [{unit}]; the setting evaluation.{axis} by default")
        for axis, unit in AXES.items()
    ),
    argument("--robots", type=int, default=ROBOTS, help=f"robots for each command of the grid; {ROBOTS} by default"),
)
"""Options that define a grid of velocity commands."""


def _points(full: str) -> tuple[Argument, Argument]:
    """Return the options --full and --robots-per-point. `full` is the text in the help that says what --full measures."""
    return (
        argument("--full", action="store_true", help=f"measure {full}; --robots-per-point is then 256 by default"),
        argument("--robots-per-point", type=int, help="robots for each terrain size or stress line; 32, or 256 with --full"),
    )


def check_points(given: int | None, full: bool) -> int:
    """Return the number of robots for each size of a terrain type: the value `given` with --robots-per-point, or the default.

    Raises:
        ConfigError: the number is below 1 or above MOST_ROBOTS / MOST_SIZES.
    """
    check_number("--robots-per-point", given, 1, MOST_ROBOTS // MOST_SIZES)
    return given if given is not None else 256 if full else 32


def settle(args: argparse.Namespace, follows: bool = True) -> Setting:
    """Return the setting of a measurement from its command line. If `follows`, the policy must follow velocity commands.

    Raises:
        ConfigError: --num-envs is given, there is no such policy or device, or the policy cannot follow commands.
        RunError: the output folder cannot be written.
    """
    register_given(args, "policy")
    if args.num_envs is not None:
        raise ConfigError("--num-envs: leave it out, because the evaluation chooses the number of robots")
    device, policy = measuring_device(args), policy_of(args.policy, args.checkpoint)
    task = policy.cfg.task
    if follows and not follows_velocities(policy.cfg):
        raise ConfigError(f"POLICY: '{task}' has no velocity commands; use `legged evaluate episodes {task}`")
    overrides = policy_overrides(args)
    own = policy.output("evaluate")
    folder = args.out or (own / CHANGED if changes_of(overrides) else own)
    ready_to_write(folder)
    return Setting(policy, device, folder, overrides, not args.no_graph, "--physics" if args.physics else "sim.physics")


def _grid_of(setting: Setting, args: argparse.Namespace | None = None) -> Grid:
    """Return the grid of commands. An axis comes from its option or, without the option, from the configuration.

    Raises:
        ConfigError: an axis is malformed, or the grid is too large.
    """
    axes = axes_of(setting.cfg)
    if args is not None:
        texts = {axis: getattr(args, axis) for axis in AXES}
        axes |= {axis: axis_values(f"--{axis}", text) for axis, text in texts.items() if text is not None}
    grid = Grid(axes["vx"], axes["vy"], axes["yaw"], ROBOTS if args is None else args.robots)
    check_size(grid)
    return grid


@sub_command("legged evaluate anymal_c --physics mujoco", "legged evaluate half_cheetah --seed 3", arguments=EVALUATED)
def evaluate(args: argparse.Namespace) -> int:
    """Measure a policy: `legged evaluate anymal_c_flat`.

    A policy that follows velocity commands is measured on a grid of commands, as in `legged evaluate grid`. If the policy was
    trained on terrain, its success on terrain is measured too, as in `legged evaluate terrain`. A policy that tracks motions
    is measured as in `legged evaluate motions`, and any other policy as in `legged evaluate episodes`. ONNX files and
    exported folders are measured as in `legged evaluate onnx`. Tables are printed. Results of a checkpoint are written to
    evaluation_<physics>.json, or to motions_<physics>.json, and pictures.
    """
    if exported_file(args.policy) is not None:
        _check_plain(args)
        return onnx.run(onnx.parse([args.policy, *(["--out", str(args.out)] if args.out else [])]))
    with hint_at_sub_command("evaluate", [args.policy]):
        setting = settle(args, follows=False)
    cfg = setting.policy.cfg
    if tracks_motions(cfg):
        return evaluate_motions(setting, STARTS)
    if not follows_velocities(cfg):
        return evaluate_episodes(setting, ENVIRONMENTS)
    sizes = chosen_sizes(cfg, None, False, setting.cfg.terrain.scale)
    return evaluate_following(setting, _grid_of(setting), sizes, check_points(None, False))


def _check_plain(args: argparse.Namespace) -> None:
    """Refuse overrides, and all options except --out. They would have no effect, because an ONNX file runs unchanged."""
    if args.overrides:
        raise ConfigError(f"{args.overrides[0]}: has no effect on an ONNX file; see the options of `legged evaluate onnx`")
    for name, value in vars(evaluate.build_parser().parse_args([args.policy])).items():
        if getattr(args, name) != value and name not in ("out", "overrides"):
            option = f"--{'import' if name == 'module' else name.replace('_', '-')}"
            raise ConfigError(f"{option}: has no effect on an ONNX file; see the options of `legged evaluate onnx`")


@sub_command(
    "legged evaluate grid anymal_c_flat --vx=-1:1:0.5 --vy=0 --yaw=0",
    "legged evaluate grid go2_flat --physics all --robots 4",
    arguments=(*EVALUATED, *GRID),
)
def grid(args: argparse.Namespace) -> int:
    """Measure velocity errors over a grid of commands: `legged evaluate grid anymal_c_flat --vx=-1:1:0.5`.

    Every cell of the grid is one command (vx, vy, yaw rate), which several robots follow. Tables of the errors are printed,
    and evaluation_<physics>.json and .png are written. With `--physics all` the grid is measured in every engine and with
    every solver of Newton, and the files are crossing.json and crossing.png.
    """
    everywhere = args.physics == EVERYWHERE
    if everywhere:
        args.physics = None
        if args.solver is not None:
            raise ConfigError(f"--solver: --physics {EVERYWHERE} measures with all solvers; leave one of the two options out")
    setting = settle(args)
    cells = _grid_of(setting, args)
    return cross(setting, cells) if everywhere else evaluate_following(setting, cells)


@sub_command(
    "legged evaluate terrain anymal_c --physics mujoco",
    "legged evaluate terrain go2 --types stairs_up,slope_up --robots-per-point 64",
    arguments=(*EVALUATED, argument("--types", help=TYPES_HELP), *_points("all sizes of a type")),
)
def terrain(args: argparse.Namespace) -> int:
    """Measure success over the size of terrain: `legged evaluate terrain anymal_c --types stairs_up,gap`.

    For each terrain type, the size (for example the height of steps) grows from tile to tile. Robots start in the middle of
    the tiles. The share of robots that walk out of their tile is printed, drawn to success_<physics>.png, and written to
    evaluation_<physics>.json.
    """
    robots = check_points(args.robots_per_point, args.full)
    setting = settle(args)
    cfg = setting.policy.cfg
    sizes = chosen_sizes(cfg, args.types, args.full, setting.cfg.terrain.scale)  # type: ignore[arg-type]
    if not sizes:
        raise ConfigError(f"POLICY: '{cfg.task}' was trained on a plane; choose terrain types with --types")
    return evaluate_following(setting, None, sizes, robots)


@sub_command(
    "legged evaluate stress anymal_c --physics mujoco",
    "legged evaluate stress go2 --lines nominal,payload,together --riser 0.12",
    arguments=(
        *EVALUATED,
        argument("--lines", help="lines of the table, e.g. 'nominal,payload,together'; by default all, which a score needs"),
        argument("--riser", type=float, help=f"height of a step [m]; {RISER} for an ANYmal C, scaled to other robots' size"),
        argument("--tread", type=float, default=TREAD, help=f"width of a step [m]; {TREAD} by default"),
        argument("--payload", type=float, help="mass on the base [kg]; 8 for an ANYmal C, scaled to other robots' mass"),
        *_points("all lines with every solver setting"),
    ),
)
def stress(args: argparse.Namespace) -> int:
    """Measure the robustness of a policy: `legged evaluate stress anymal_c`.

    Robots walk on stairs and on the flat. The lines of the table are for disturbances (payload, friction, weak motors,
    delay, ...), for terrain on which no task is trained, and for different solver settings. The share of robots that
    succeed is printed and written to stress_<physics>.json and .png.
    """
    robots = check_points(args.robots_per_point, args.full)
    check_between("--riser", args.riser, 0.0, 1.0, "m")
    check_between("--tread", args.tread, 0.05, 2.0, "m")
    check_between("--payload", args.payload, 0.0, 1000.0, "kg")
    lines = [name.strip() for name in args.lines.split(",")] if args.lines is not None else []
    for name in lines:
        if name not in NAMES:
            raise ConfigError(f"--lines: there is no line '{name}'{suggest(name, NAMES)}")
    return evaluate_stress(Bench(settle(args), robots, args.riser, args.tread, args.payload, lines), args.full)


@sub_command(
    "legged evaluate checkpoints anymal_c_flat",
    "legged evaluate checkpoints go1_flat/2026-11-22_05-38-19 --rmse 0.2 --falls 0.01",
    arguments=(
        *EVALUATED,
        *GRID,
        argument(
            "--rmse",
            type=float,
            default=WALKING_RMSE,
            help=f"largest velocity RMSE with which a checkpoint walks [m/s]; {WALKING_RMSE} by default",
        ),
        argument("--falls", type=float, default=WALKING_FALLS, help=f"largest share of falls; {WALKING_FALLS} by default"),
    ),
)
def checkpoints(args: argparse.Namespace) -> int:
    """Search a run for its first checkpoint that walks: `legged evaluate checkpoints anymal_c_flat`.

    Every checkpoint of the run is measured over the grid of commands. A checkpoint walks if its velocity RMSE is below --rmse
    and its share of falls is below --falls. time_to_walk.json gives the time from the start of the training process to the
    first checkpoint that walks [s]. For a more exact time, train with a smaller train.runner.save_interval.
    """
    check_number("--rmse", args.rmse, 0, 100, above=True)
    check_number("--falls", args.falls, 0, 1, above=True)
    if args.checkpoint is not None:
        raise ConfigError("--checkpoint: leave it out, because all checkpoints of the run are measured")
    setting = settle(args)
    return evaluate_all_checkpoints(setting, _grid_of(setting, args), args.rmse, args.falls)


def _episodes(count: int) -> Argument:
    """Return the option for the number of episodes, `count` by default."""
    return argument("--episodes", type=int, default=count, help=f"number of episodes; {count} by default")


@sub_command(
    "legged evaluate episodes half_cheetah",
    "legged evaluate episodes humanoid --episodes 64 --physics mujoco",
    arguments=(*EVALUATED, _episodes(ENVIRONMENTS)),
)
def episodes(args: argparse.Namespace) -> int:
    """Measure returns and lengths of full episodes: `legged evaluate episodes half_cheetah`.

    The command is for tasks without velocity commands. The figures are printed and written to evaluation_<physics>.json.
    """
    check_number("--episodes", args.episodes, 1, MOST_EPISODES)
    setting = settle(args, follows=False)
    if follows_velocities(setting.policy.cfg):
        task = setting.policy.cfg.task
        raise ConfigError(f"POLICY: '{task}' follows velocity commands; use `legged evaluate grid {task}`")
    return evaluate_episodes(setting, args.episodes)


@sub_command(
    "legged evaluate motions g1_tracking",
    "legged evaluate motions g1_tracking --physics mujoco motion.files=[clips/dance.npz]",
    arguments=(*EVALUATED, _episodes(STARTS)),
)
def motions(args: argparse.Namespace) -> int:
    """Measure how well a policy tracks motions: `legged evaluate motions g1_tracking`.

    Robots begin in random frames of each motion. An episode succeeds if it lasts 10 s without a failure. One more robot
    begins in the first frame and has to reach the last one. Success and errors are printed, and written to
    motions_<physics>.json.
    """
    check_number("--episodes", args.episodes, 1, MOST_EPISODES)
    setting = settle(args, follows=False)
    if not tracks_motions(setting.policy.cfg):
        raise ConfigError(f"POLICY: '{setting.policy.cfg.task}' tracks no motions; use `legged evaluate`")
    return evaluate_motions(setting, args.episodes)


@sub_command(
    "legged evaluate gymnasium half_cheetah",
    "legged evaluate gymnasium half_cheetah --episodes 100",
    arguments=(*EVALUATED, _episodes(IN_GYMNASIUM)),
)
def gymnasium(args: argparse.Namespace) -> int:
    """Measure returns of a policy in Gymnasium's own environment: `legged evaluate gymnasium half_cheetah`.

    The exported policy acts in the Gymnasium environment that the task reproduces. Gymnasium computes the returns, which are
    printed and written to evaluation_gymnasium.json.
    """
    check_number("--episodes", args.episodes, 1, MOST_EPISODES)
    for option in ("physics", "solver", "sim_device"):
        if getattr(args, option) is not None:
            raise ConfigError(f"--{option.replace('_', '-')}: leave it out, because Gymnasium simulates the robots")
    return evaluate_in_gymnasium(settle(args, follows=False), args.episodes)


# ---- ONNX files ------------------------------------------------------------------------------------------------------


COMMANDS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.8), (-0.5, 0.0, 0.0))
"""Default commands: vx, vy [m/s], yaw rate [rad/s]."""
SECONDS, HOLD_S = 8.0, Grid.hold_s
"""Default time for which a robot follows each command [s]: SECONDS in a list of commands, HOLD_S in a grid."""
MOST_CELLS = 10_000
"""Largest number of commands of a grid. It is limited because a single robot follows all commands, one after another."""
FRICTION = 0.8
"""Default friction between robot and ground."""
EPISODES = 128
"""Number of robots that begin in random frames of a tracker's motion."""
RESULT = "onnx.json"
EXPORTED = ("policy.onnx", "policy.json")
"""Files of an exported folder: the network, and its description."""


@sub_command(
    "legged evaluate onnx logs/go1_flat/2026-11-22_05-38-19/exported --vx=-0.5:1:0.5 --rmse 0.2",
    "legged evaluate onnx policy.onnx --robot g1 --layout holosoma",
    arguments=(
        argument("policy", nargs="+", metavar="POLICY", help="ONNX files, or exported folders"),
        argument("--robot", help="name or folder of the robot; by default the robot that policy.json names"),
        argument(
            "--layout",
            help="description of observation and action: a YAML file, the name of one in this package such as holosoma, or a"
            " policy.json; by default the policy.json next to the ONNX file",
        ),
        argument("--command", action="append", metavar="VX,VY,YAW", help="a command [m/s, m/s, rad/s]; may be repeated"),
        *(
            argument(f"--{axis}", help=f"{axis} in a grid, low:high:step [{unit}]; {AXIS} if only other axes are given")
            for axis, unit in AXES.items()
        ),
        argument("--seconds", type=float, help=f"time for each command [s]; by default {SECONDS:g}, in a grid {HOLD_S:g}"),
        argument("--friction", type=float, help=f"friction between robot and ground; {FRICTION:g} by default"),
        argument("--rmse", type=float, help="print the first policy whose mean velocity RMSE is at most this [m/s]"),
        argument("--out", type=Path, help=f"folder for {RESULT}; no file is written by default"),
    ),
)
def onnx(args: argparse.Namespace) -> int:
    """Measure ONNX policies of this or another project in plain MuJoCo: `legged evaluate onnx exported/policy.onnx`.

    One robot on a plane follows commands in C MuJoCo, and the reached velocities are printed. These velocities show whether
    model, frames, joint order and gains are those of the training. A policy that this package exported has a policy.json next
    to it, which describes robot and control. For a policy of another project, give --robot and --layout.

    If the layout names a `task`, or policy.json describes a policy that tracks motions, the files are trackers, which hold
    their motion. Robots then track it from random frames for 10 s, and from the first frame to its end. Of an exported
    folder, all trackers are measured.

    With --vx, --vy or --yaw the errors over a grid of commands are measured, and policies are sorted by training time. With
    --rmse the command also prints the first policy whose velocity RMSE is at most --rmse and whose robot never falls.
    """
    grid = _grid_in(args)
    settling = grid.settle_s if grid else SETTLING_S
    seconds = args.seconds if args.seconds is not None else grid.hold_s if grid else SECONDS
    if not settling < seconds <= 1000.0:
        raise ConfigError(f"--seconds: must be above {settling:g} (the settling time) and at most 1000, got {seconds}")
    if args.friction is not None and not 0.0 <= args.friction <= 10.0:
        raise ConfigError(f"--friction: must be from 0 to 10, got {args.friction}")
    commands = [velocity_command(text) for text in args.command or ()] or COMMANDS
    files = [onnx_file(name) for name in args.policy]
    if args.out is not None:
        ready_to_write(args.out)
    layouts = [read_layout(args.layout or str(description_of(path, files[0])), "--layout") for path in files]
    if layouts[0].task:
        return _replay(files, layouts, args)
    args.friction = FRICTION if args.friction is None else args.friction
    contract = layouts[0].contract
    if args.robot is None and contract is None:
        raise ConfigError(f"--robot: is missing; name a robot, because the layout '{args.layout}' names none")
    robot = load_robot(args.robot or contract.robot, "--robot")  # type: ignore[union-attr]
    policies = [ForeignPolicy(path, layout, robot) for path, layout in zip(files, layouts, strict=True)]
    if contract is not None and was_trained_with_other_motors(contract):
        told = "the policy was trained with other motors (`actuator` in this file); this evaluation uses ideal motors"
        print(f"warning: {contract.path}: {told}", file=sys.stderr, flush=True)
    if grid:
        result = _follow_all(robot, policies, files, args, grid)
    else:
        said = []
        for path, policy in zip(files, policies, strict=True):
            rows = play(robot, policy, commands, seconds, args.friction)
            Console(width=100).print(_table(rows, path.name))
            said.append({"file": str(path), "commands": rows})
        result = {"robot": robot.name, "friction": args.friction, "seconds": seconds, "policies": said}
    if args.out is not None:
        make_folder(args.out)
        write_text(args.out / RESULT, json.dumps(result, indent=1))
        print(f"written: {relative(args.out / RESULT)}")
    return 0


def _replay(files: list[Path], layouts: list[Layout], args: argparse.Namespace) -> int:
    """Let trackers track the motions in their files, print a table, and return the exit code.

    Raises:
        ConfigError: an option is given that has no effect on trackers.
    """
    for option in ("robot", "command", *AXES, "seconds", "friction", "rmse"):
        if getattr(args, option) is not None:
            raise ConfigError(f"--{option}: has no effect on a tracker, whose layout names a task")
    result = [
        Tracker(tracker, layout, EPISODES).measure()
        for path, layout in zip(files, layouts, strict=True)
        for tracker in _trackers(path, layout)
    ]
    title = f"trackers in C MuJoCo: {EPISODES} episodes of {SUCCESS_S:g} s a motion"
    Console(width=140).print(motions_table(title, ((Path(row["file"]).name, row) for row in result)))
    if args.out is not None:
        make_folder(args.out)
        write_text(args.out / RESULT, json.dumps({"trackers": result}, indent=1))
        print(f"written: {relative(args.out / RESULT)}")
    return 0


def _trackers(file: Path, layout: Layout) -> list[Path]:
    """Return `file`, but the trackers beside it if it is the policy of an export without a motion."""
    if layout.contract is None or file.name != EXPORTED[0]:
        return [file]
    return [file.with_name(name) for name in layout.contract.trackers]


def exported_file(name: str) -> Path | None:
    """Return the ONNX file `name`, or the ONNX file in the exported folder `name`; None if `name` is something else."""
    path = Path(name)
    if path.suffix == ".onnx":
        return path
    inside = path / EXPORTED[0]
    return inside if exists(inside) and not exists(path / CONFIG_FILE) else None


def onnx_file(name: str) -> Path:
    """Return the ONNX file `name`, or the ONNX file in the exported folder `name`. Raise ConfigError if neither exists."""
    path = exported_file(name)
    if path is None or not exists(path) or not path.is_file():
        raise ConfigError(f"POLICY: there is no ONNX file '{name}', and no exported folder (with {EXPORTED[0]}) of this name")
    return path


def description_of(file: Path, first: Path) -> Path:
    """Return the policy.json next to `file`, or else the policy.json next to `first`."""
    path = next((path for path in (file.with_name(EXPORTED[1]), first.with_name(EXPORTED[1])) if exists(path)), None)
    if path is None:
        raise ConfigError(f"{first}: there is no {EXPORTED[1]} next to it; describe its observation with --layout")
    return path


def _grid_in(args: argparse.Namespace) -> Grid | None:
    """Return the grid that --vx, --vy and --yaw define; None if all three are missing."""
    if all(getattr(args, axis) is None for axis in AXES):
        if args.rmse is not None:
            raise ConfigError("--rmse: has no effect without a grid of commands; add --vx, --vy or --yaw")
        return None
    if args.command:
        raise ConfigError("--command: cannot be combined with a grid; leave out --command, or leave out --vx, --vy and --yaw")
    check_number("--rmse", args.rmse, 0, 100, above=True)
    given = {axis: AXIS if getattr(args, axis) is None else getattr(args, axis) for axis in AXES}
    vx, vy, yaw = (axis_values(f"--{axis}", text) for axis, text in given.items())
    grid = Grid(vx, vy, yaw, robots=1, hold_s=HOLD_S if args.seconds is None else args.seconds)
    check_size(grid)
    if grid.num_cells > MOST_CELLS:
        raise ConfigError(f"--vx, --vy, --yaw: the grid has {grid.num_cells:,} commands; at most {MOST_CELLS:,} are possible")
    return grid


def _follow_all(
    robot: Robot, policies: list[ForeignPolicy], files: list[Path], args: argparse.Namespace, grid: Grid
) -> dict[str, Any]:
    """Measure every policy on the grid, print a line about each, and return all figures. Policies are sorted by
    training time. Policies that do not state this time come first.
    """
    known = [(path, policy, _marks(policy)) for path, policy in zip(files, policies, strict=True)]
    heads = ("seconds", "velocity RMSE", "worst", "yaw rate RMSE", "worst", "falls")
    print(f"{robot.name}: {grid.num_cells} commands, {grid.hold_s:g} s each; errors in m/s and rad/s")
    print("".join(f"{head:>15}" for head in heads) + "  file", flush=True)
    rows: list[dict[str, Any]] = []
    for path, policy, marks in sorted(known, key=lambda one: one[2].get("wall_s", 0.0)):
        row = {"file": str(path), **marks, **follow(robot, policy, grid, args.friction)}
        rows.append(row)
        errors = [row[name][part] for name in ("rmse_lin", "rmse_ang") for part in ("mean", "worst")]
        figures = [f"{row['wall_s']:.1f}" if "wall_s" in row else "-"]
        figures += ["-" if error is None else f"{error:.3f}" for error in errors]
        print("".join(f"{text:>15}" for text in (*figures, f"{100 * row['falls']:.1f} %")) + f"  {row['file']}", flush=True)
    result = {
        "robot": robot.name,
        "friction": args.friction,
        "sim_dt": policies[0].layout.sim_dt,
        "grid": grid.axes,
        "hold_s": grid.hold_s,
        "settle_s": grid.settle_s,
        "policies": rows,
    }
    if args.rmse is None:
        return result
    ended = (row for row in rows if row["falls"] == 0.0 and row["rmse_lin"]["mean"] is not None)
    first = next((row for row in ended if row["rmse_lin"]["mean"] <= args.rmse), None)
    when = f" after {first['wall_s']:.1f} s of training" if first and "wall_s" in first else ""
    print(f"first policy with velocity RMSE <= {args.rmse:g} m/s without a fall: {first['file'] + when if first else 'none'}")
    return {**result, "rmse": args.rmse, "first": first and {k: v for k, v in first.items() if k != "cells"}}


def _marks(policy: ForeignPolicy) -> dict[str, float]:
    """Return `wall_s` (training time [s]) and `iterations` from a policy's metadata. Missing values are left out."""
    found = {}
    for name in ("wall_s", "iterations"):
        try:
            found[name] = float(policy.metadata[name])
        except (KeyError, ValueError):
            continue
    return found


def _table(rows: list[dict[str, Any]], name: str) -> Table:
    def text(values: list[float] | None) -> str:
        return "-" if values is None else " ".join(f"{value:6.2f}" for value in values)

    lines = []
    for row in rows:
        height, fell_after = row["lowest_base"], row["fell_after"]
        ends = ("-" if height is None else f"{height:.3f}", "-" if fell_after is None else f"{fell_after:.2f} s")
        lines.append([text(row["command"]), text(row["velocity"]), *ends])
    title = f"{name}: velocities after {SETTLING_S:g} s, base frame [m/s, m/s, rad/s]"
    return screen_table(title, ("command", "reached", "lowest base [m]", "fell after"), lines, left=())
