"""Policies in C MuJoCo, others' or our own: `python -m legged.tools.playback g1 policy.onnx --layout holosoma`.

Plays ONNX files, one robot on a plane, and prints the velocities that it reaches. Whether the robot walks says whether model,
frames, orders and gains are those that the policy was trained with. With --vx, --vy or --yaw, each low:high:step, it measures
instead how well all these commands are followed, as legged.tools.evaluate does; of several files, such as the checkpoints of
a training, with --rmse also which is the first that does.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser
from legged.errors import ConfigError
from legged.evaluation.playback import SETTLING_S, Played, follow, play
from legged.evaluation.velocity_grid import AXES, AXIS, Grid, axis_values, check_size
from legged.policies.foreign import ForeignPolicy, Layout, read_layout, was_trained_with_other_motors
from legged.process.paths import exists, ready_to_write_file, relative, write_text
from legged.robots.robot import Robot, load_robot

COMMANDS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.8), (-0.5, 0.0, 0.0))
"""vx, vy [m/s], yaw rate [rad/s]."""
SECONDS, HOLD_S = 8.0, Grid.hold_s
"""Length of a single command, and of one of a grid, if nobody says how long [s]."""
MOST_CELLS = 10_000
"""Commands of a grid, at most: each is seconds of one robot."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "playback",
        __doc__,
        "python -m legged.tools.playback g1 policy.onnx --layout holosoma",
        "python -m legged.tools.playback go1 exported/policy.onnx --layout exported/policy.json --vx=-0.5:1:0.5 --rmse 0.2",
    )
    parser.add_argument("robot", help="a robot's name, or its folder")
    parser.add_argument("policy", type=Path, nargs="+", help="the ONNX files")
    parser.add_argument(
        "--layout",
        required=True,
        help="what their observation is made of: a YAML file, 'holosoma', or the policy.json of one of our exports",
    )
    parser.add_argument(
        "--command", nargs=3, type=float, action="append", metavar=("VX", "VY", "YAW"), help="m/s, m/s, rad/s; may come again"
    )
    for axis, unit in AXES.items():
        parser.add_argument(f"--{axis}", help=f"low:high:step of a grid of commands [{unit}]; {AXIS} if another is given")
    parser.add_argument("--seconds", type=float, help=f"length of each command; {SECONDS:g}, of a grid's {HOLD_S:g}")
    parser.add_argument("--friction", type=float, default=0.8)
    parser.add_argument("--rmse", type=float, help="largest mean velocity RMSE of a grid that is followed [m/s]")
    parser.add_argument("--json", type=Path, help="file for the figures")
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    grid = _grid(args)
    settling = grid.settle_s if grid else SETTLING_S
    seconds = args.seconds if args.seconds is not None else grid.hold_s if grid else SECONDS
    if not settling < seconds <= 1000.0:
        raise ConfigError(f"--seconds: must be above {settling:g}, which it has to settle, and at most 1000, got {seconds}")
    if not 0.0 <= args.friction <= 10.0:
        raise ConfigError(f"--friction: must be from 0 to 10, got {args.friction}")
    commands = args.command or COMMANDS
    if not all(abs(value) <= 100.0 for command in commands for value in command):
        raise ConfigError("--command: velocities must be numbers of at most 100")
    for path in args.policy:
        if not exists(path) or not path.is_file():
            raise ConfigError(f"policy: there is no file {path}")
    if args.json is not None:
        ready_to_write_file("--json", args.json)
    robot, layout = load_robot(args.robot), read_layout(args.layout, "--layout")
    policies = [ForeignPolicy(path, layout, robot) for path in args.policy]
    if args.layout.endswith(".json") and was_trained_with_other_motors(Path(args.layout)):
        told = "the policy was trained with motors that are not ideal (its actuator says which); here they are"
        print(f"warning: {args.layout}: {told}", file=sys.stderr, flush=True)
    if grid:
        result = _follow_all(robot, layout, policies, args, grid)
    else:
        played = [play(robot, policy, commands, seconds, args.friction) for policy in policies]
        for path, rows in zip(args.policy, played, strict=True):
            Console(width=100).print(_table(rows, path.name))
        result = {
            "robot": robot.name,
            "friction": args.friction,
            "seconds": seconds,
            "policies": [
                {"file": str(path), "commands": [_row(row) for row in rows]}
                for path, rows in zip(args.policy, played, strict=True)
            ],
        }
    if args.json is not None:
        write_text(args.json, json.dumps(result, indent=1))
        print(f"written: {relative(args.json)}")
    return 0


def _grid(args: argparse.Namespace) -> Grid | None:
    """Return the grid that the command line asks for; None if it asks for none.

    Raises:
        ConfigError: it is none, or asks for single commands too.
    """
    if all(getattr(args, axis) is None for axis in AXES):
        if args.rmse is not None:
            raise ConfigError("--rmse: is a limit of a grid of commands; add --vx, --vy or --yaw")
        return None
    if args.command:
        raise ConfigError("--command: is no part of a grid; leave out either it or --vx, --vy and --yaw")
    if args.rmse is not None and not 0.0 < args.rmse <= 100.0:
        raise ConfigError(f"--rmse: must be above 0 and at most 100, got {args.rmse}")
    given = {axis: AXIS if getattr(args, axis) is None else getattr(args, axis) for axis in AXES}
    vx, vy, yaw = (axis_values(f"--{axis}", text) for axis, text in given.items())
    grid = Grid(vx, vy, yaw, robots=1, hold_s=HOLD_S if args.seconds is None else args.seconds)
    check_size(grid)
    if grid.num_cells > MOST_CELLS:
        raise ConfigError(f"--vx, --vy, --yaw: {grid.num_cells:,} commands; at most {MOST_CELLS:,} are possible")
    return grid


def _follow_all(
    robot: Robot, layout: Layout, policies: list[ForeignPolicy], args: argparse.Namespace, grid: Grid
) -> dict[str, Any]:
    """Measure every policy on the grid, print a line on each, and return all figures; of policies that say after how many
    seconds of training they were written, the earliest comes first.
    """
    marks = [_marks(policy) for policy in policies]
    order = sorted(range(len(policies)), key=lambda i: marks[i].get("wall_s", 0.0))
    heads = ("seconds", "velocity RMSE", "worst", "yaw rate RMSE", "worst", "falls")
    print(f"{robot.name}: {grid.num_cells} commands, {grid.hold_s:g} s each; errors in m/s and rad/s")
    print("".join(f"{head:>15}" for head in heads) + "  file", flush=True)
    rows: list[dict[str, Any]] = []
    for i in order:
        row = {"file": str(args.policy[i]), **marks[i], **follow(robot, policies[i], grid, args.friction)}
        rows.append(row)
        errors = [row[name][part] for name in ("rmse_lin", "rmse_ang") for part in ("mean", "worst")]
        figures = [f"{row['wall_s']:.1f}" if "wall_s" in row else "-"]
        figures += ["-" if error is None else f"{error:.3f}" for error in errors]
        print("".join(f"{text:>15}" for text in (*figures, f"{100 * row['falls']:.1f} %")) + f"  {row['file']}", flush=True)
    result = {
        "robot": robot.name,
        "friction": args.friction,
        "sim_dt": layout.sim_dt,
        "grid": grid.axes,
        "hold_s": grid.hold_s,
        "settle_s": grid.settle_s,
        "policies": rows,
    }
    if args.rmse is None:
        return result
    first = next((row for row in rows if _follows(row, args.rmse)), None)
    when = f" after {first['wall_s']:.1f} s of training" if first and "wall_s" in first else ""
    print(f"velocity RMSE <= {args.rmse:g} m/s without a fall: {first['file'] + when if first else 'none'}")
    return {**result, "rmse": args.rmse, "first": first and {k: v for k, v in first.items() if k != "cells"}}


def _follows(row: dict[str, Any], rmse: float) -> bool:
    mean = row["rmse_lin"]["mean"]
    return row["falls"] == 0.0 and mean is not None and mean <= rmse


def _marks(policy: ForeignPolicy) -> dict[str, float]:
    """Return what the file says of its training: seconds and iterations, as far as they are numbers."""
    found = {}
    for name in ("wall_s", "iterations"):
        try:
            found[name] = float(policy.metadata[name])
        except (KeyError, ValueError):
            continue
    return found


def _row(row: Played) -> dict[str, Any]:
    """Return a command's figures for JSON: what is not defined is null."""
    velocity = None if row.fell_after is not None else list(row.velocity)
    height = None if velocity is None else row.height
    return {"command": list(row.command), "velocity": velocity, "lowest_base": height, "fell_after": row.fell_after}


def _table(rows: list[Played], name: str) -> Table:
    table = Table(title=f"{name}: velocities after {SETTLING_S:g} s, base frame [m/s, m/s, rad/s]")
    for heading in ("command", "reached", "lowest base [m]", "fell after"):
        table.add_column(heading, justify="right")
    for row in rows:
        command, reached = (" ".join(f"{value:6.2f}" for value in values) for values in (row.command, row.velocity))
        table.add_row(command, reached, f"{row.height:.3f}", "-" if row.fell_after is None else f"{row.fell_after:.2f} s")
    return table


if __name__ == "__main__":
    sys.exit(main())
