"""A policy that others trained, on our model: `python -m legged.tools.playback g1 policy.onnx --layout holosoma`.

Plays an ONNX file in C MuJoCo, one robot on a plane, and prints the velocities that it reaches. Whether the robot walks says
whether model, frames, orders and gains are those that the policy was trained with.
"""

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from legged.commandline.command import run_main
from legged.errors import ConfigError
from legged.evaluation.playback import SETTLING_S, Played, play
from legged.policies.foreign import ForeignPolicy, read_layout
from legged.process.paths import exists
from legged.robots.robot import load_robot

COMMANDS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.8), (-0.5, 0.0, 0.0))
"""vx, vy [m/s], yaw rate [rad/s]."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="playback", description=__doc__)
    parser.add_argument("robot", help="a robot's name, or its folder")
    parser.add_argument("policy", type=Path, help="the ONNX file")
    parser.add_argument("--layout", required=True, help="what its observation is made of: a YAML file, or 'holosoma'")
    parser.add_argument(
        "--command", nargs=3, type=float, action="append", metavar=("VX", "VY", "YAW"), help="m/s, m/s, rad/s; may come again"
    )
    parser.add_argument("--seconds", type=float, default=8.0, help="length of each command")
    parser.add_argument("--friction", type=float, default=0.8)
    args = parser.parse_args(argv)
    if not SETTLING_S < args.seconds <= 1000.0:
        raise ConfigError(
            f"--seconds: must be above {SETTLING_S:g}, which it has to settle, and at most 1000, got {args.seconds}"
        )
    if not 0.0 <= args.friction <= 10.0:
        raise ConfigError(f"--friction: must be from 0 to 10, got {args.friction}")
    commands = args.command or COMMANDS
    if not all(abs(value) <= 100.0 for command in commands for value in command):
        raise ConfigError("--command: velocities must be numbers of at most 100")
    if not exists(args.policy) or not args.policy.is_file():
        raise ConfigError(f"policy: there is no file {args.policy}")
    robot = load_robot(args.robot)
    policy = ForeignPolicy(args.policy, read_layout(args.layout, "--layout"), robot)
    Console(width=100).print(_table(play(robot, policy, commands, args.seconds, args.friction), args.policy.name))
    return 0


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
