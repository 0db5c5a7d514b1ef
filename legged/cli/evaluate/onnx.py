"""ONNX policies in plain MuJoCo, foreign ones too: `legged evaluate onnx exported/policy.onnx`.

One robot on a plane follows commands in C MuJoCo, and the reached velocities are printed. They show whether model, frames,
joint order and gains are those of the training. An exported policy of this package has a policy.json next to it, which
describes robot and control; for a foreign policy give --robot and --layout.

With --vx, --vy or --yaw a grid of commands is measured as by `legged evaluate grid`. With --rmse too, the command prints the
first of several files, such as the checkpoints of a training, that follows the grid.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from legged.cli.evaluate.common import check_number
from legged.commandline.command import run_main
from legged.errors import ConfigError
from legged.evaluation.playback import SETTLING_S, follow, play
from legged.evaluation.velocity_grid import AXES, AXIS, Grid, axis_values, check_size
from legged.learning.run_folder import CONFIG_FILE
from legged.policies.foreign import ForeignPolicy, read_layout, was_trained_with_other_motors
from legged.process.command_parser import CommandParser
from legged.process.paths import exists, make_folder, ready_to_write, relative, write_text
from legged.robots.robot import Robot, load_robot
from legged.tables import screen_table

COMMANDS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.8), (-0.5, 0.0, 0.0))
"""Default commands: vx, vy [m/s], yaw rate [rad/s]."""
SECONDS, HOLD_S = 8.0, Grid.hold_s
"""Default length of a single command, and of a command of a grid [s]."""
MOST_CELLS = 10_000
"""Largest number of commands of a grid; one robot takes seconds for each."""
RESULT = "onnx.json"
EXPORTED = ("policy.onnx", "policy.json")
"""Files of an exported folder: the network, and its description."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(evaluate, argv)


def exported_file(name: str) -> Path | None:
    """Return the ONNX file that POLICY names directly or by its exported folder; None if POLICY names something else."""
    path = Path(name)
    if path.suffix == ".onnx":
        return path
    inside = path / EXPORTED[0]
    return inside if exists(inside) and not exists(path / CONFIG_FILE) else None


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged evaluate onnx",
        __doc__,
        "legged evaluate onnx logs/go1_flat/2026-11-22_05-38-19/exported --vx=-0.5:1:0.5 --rmse 0.2",
        "legged evaluate onnx policy.onnx --robot g1 --layout holosoma",
    )
    parser.add_argument("policy", nargs="+", metavar="POLICY", help="ONNX files, or exported folders")
    parser.add_argument("--robot", help="name or folder of the robot; that of the policy.json by default")
    parser.add_argument(
        "--layout",
        help="what the observation is made of: a YAML file, 'holosoma', or a policy.json; the one beside the file by default",
    )
    parser.add_argument(
        "--command", action="append", metavar="VX,VY,YAW", help="a command [m/s, m/s, rad/s]; may be repeated"
    )
    for axis, unit in AXES.items():
        parser.add_argument(f"--{axis}", help=f"low:high:step of a grid of commands [{unit}]; {AXIS} if another one is given")
    parser.add_argument("--seconds", type=float, help=f"length of each command; {SECONDS:g}, of a grid's {HOLD_S:g}")
    parser.add_argument("--friction", type=float, default=0.8, help="between robot and ground; 0.8 by default")
    parser.add_argument("--rmse", type=float, help="largest mean velocity RMSE of a grid that is followed [m/s]")
    parser.add_argument("--out", type=Path, help=f"folder for {RESULT}; without it nothing is written")
    return parser


def evaluate(argv: list[str] | None) -> int:
    """Evaluate the policies of a command line; return the exit code.

    Raises:
        ConfigError: an argument or a file is wrong.
    """
    args = build_parser().parse_args(argv)
    grid = _grid(args)
    settling = grid.settle_s if grid else SETTLING_S
    seconds = args.seconds if args.seconds is not None else grid.hold_s if grid else SECONDS
    if not settling < seconds <= 1000.0:
        raise ConfigError(
            f"--seconds: must be above {settling:g}, in which the robot settles, and at most 1000, got {seconds}"
        )
    if not 0.0 <= args.friction <= 10.0:
        raise ConfigError(f"--friction: must be from 0 to 10, got {args.friction}")
    commands = [_command(text) for text in args.command or ()] or COMMANDS
    files = [_file(name) for name in args.policy]
    if args.out is not None:
        ready_to_write(args.out)
    layouts = [read_layout(args.layout or str(_description(path, files[0])), "--layout") for path in files]
    contract = layouts[0].contract
    if args.robot is None and contract is None:
        raise ConfigError(f"--robot: is missing; the layout '{args.layout}' names none")
    robot = load_robot(args.robot or contract.robot, "--robot")  # type: ignore[union-attr]
    policies = [ForeignPolicy(path, layout, robot) for path, layout in zip(files, layouts, strict=True)]
    if contract is not None and was_trained_with_other_motors(contract):
        told = "the policy was trained with motors that are not ideal (its actuator says which); here they are"
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


def _file(name: str) -> Path:
    """Return the ONNX file that POLICY names."""
    path = exported_file(name)
    if path is None or not exists(path) or not path.is_file():
        raise ConfigError(f"POLICY: there is no ONNX file '{name}', nor is it an exported folder (with {EXPORTED[0]})")
    return path


def _description(file: Path, first: Path) -> Path:
    """Return the policy.json next to a file, or else next to the first file."""
    path = next((path for path in (file.with_name(EXPORTED[1]), first.with_name(EXPORTED[1])) if exists(path)), None)
    if path is None:
        raise ConfigError(f"{first}: no {EXPORTED[1]} lies beside it; give the contents of its observation with --layout")
    return path


def _command(text: str) -> tuple[float, ...]:
    """Return vx, vy [m/s] and yaw rate [rad/s]."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(abs(value) <= 100.0 for value in values):
        raise ConfigError(f"--command: expected three numbers of at most 100 like 0.5,0,0.2, got '{text}'")
    return values


def _grid(args: argparse.Namespace) -> Grid | None:
    """Return the grid of the command line; None without --vx, --vy and --yaw."""
    if all(getattr(args, axis) is None for axis in AXES):
        if args.rmse is not None:
            raise ConfigError("--rmse: is a limit of a grid of commands; add --vx, --vy or --yaw")
        return None
    if args.command:
        raise ConfigError("--command: is not part of a grid; leave out either it or --vx, --vy and --yaw")
    check_number("--rmse", args.rmse, 0, 100, above=True)
    given = {axis: AXIS if getattr(args, axis) is None else getattr(args, axis) for axis in AXES}
    vx, vy, yaw = (axis_values(f"--{axis}", text) for axis, text in given.items())
    grid = Grid(vx, vy, yaw, robots=1, hold_s=HOLD_S if args.seconds is None else args.seconds)
    check_size(grid)
    if grid.num_cells > MOST_CELLS:
        raise ConfigError(f"--vx, --vy, --yaw: {grid.num_cells:,} commands; at most {MOST_CELLS:,} are possible")
    return grid


def _follow_all(
    robot: Robot, policies: list[ForeignPolicy], files: list[Path], args: argparse.Namespace, grid: Grid
) -> dict[str, Any]:
    """Measure every policy on the grid, print a line about each, and return all figures. Policies that state their training
    time are sorted by it.
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
    print(f"velocity RMSE <= {args.rmse:g} m/s without a fall: {first['file'] + when if first else 'none'}")
    return {**result, "rmse": args.rmse, "first": first and {k: v for k, v in first.items() if k != "cells"}}


def _marks(policy: ForeignPolicy) -> dict[str, float]:
    """Return the seconds and iterations of training from the file's metadata, as far as they are numbers."""
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
