"""Arguments and set-up that the sub-commands of `legged evaluate` share."""

import argparse
from pathlib import Path

import torch

from legged.commandline.arguments import add_policy_arguments, pick_device, policy_overrides, register_given, settle_on
from legged.config import LeggedConfig
from legged.errors import ConfigError
from legged.evaluation.measurement import Setting
from legged.evaluation.result_file import CHANGED, changes_of
from legged.evaluation.velocity_grid import AXES, MOST_ROBOTS, Grid, axes_of, axis_values, check_size
from legged.policies.restore import policy_of
from legged.process.command_parser import CommandParser
from legged.process.paths import ready_to_write

ROBOTS = 16
"""Default number of robots for each cell of the grid."""
MOST_SIZES = 16
"""Largest number of sizes of a terrain type that are measured at the same time."""


def evaluation_parser(command: str, description: str | None, *examples: str) -> CommandParser:
    """Return a parser with the arguments that all evaluations of a checkpoint have."""
    parser = CommandParser(f"legged {command}", description, *examples)
    add_policy_arguments(parser)
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for JSON and PNG files; by default the checkpoint's, logs/evaluate for a shipped policy, and changed/ in"
        " it if fields are overridden",
    )
    return parser


def add_grid_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a grid of velocity commands."""
    for axis, unit in AXES.items():
        parser.add_argument(f"--{axis}", help=f"low:high:step of the command grid [{unit}]; evaluation.{axis} by default")
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"robots a cell; {ROBOTS} by default")


def add_points_arguments(parser: argparse.ArgumentParser, full: str) -> None:
    """Add the options for the number of robots at each size of a terrain type; `full` is the help of --full."""
    parser.add_argument("--full", action="store_true", help=f"{full}, and 256 robots each")
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a type; 32, or 256 with --full")


def settle(args: argparse.Namespace, follows: bool = True) -> Setting:
    """Return the setting of a command line. If the evaluation `follows` commands, the policy must do so too.

    Raises:
        ConfigError: there is no such policy or device, or the folder cannot be written.
    """
    register_given(args, "policy")
    if args.num_envs is not None:
        raise ConfigError("--num-envs: the evaluation chooses the number of robots; leave it out")
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    policy = policy_of(args.policy, args.checkpoint)
    task = policy.cfg.task
    if follows and not isinstance(policy.cfg, LeggedConfig):
        raise ConfigError(f"POLICY: '{task}' has no velocity commands; legged evaluate episodes {task} measures its returns")
    overrides = policy_overrides(args)
    own = policy.output("evaluate")
    folder = args.out or (own / CHANGED if changes_of(overrides) else own)
    ready_to_write(folder)
    return Setting(policy, device, folder, overrides, not args.no_graph, "--physics" if args.physics else "sim.physics")


def grid_of(setting: Setting, args: argparse.Namespace | None = None) -> Grid:
    """Return the grid of commands from the options, or from the configuration for options that are not given.

    Raises:
        ConfigError: an axis is malformed, or the grid is too large.
    """
    axes = axes_of(setting.cfg)
    if args is not None:
        texts = {axis: getattr(args, axis) for axis in AXES}
        axes |= {axis: axis_values(f"--{axis}", text) for axis, text in texts.items() if text is not None}
    grid = Grid(**axes, robots=ROBOTS if args is None else args.robots)
    check_size(grid)
    return grid


def check_points(given: int | None, full: bool) -> int:
    """Return the number of robots for each size of a terrain type: `given` by --robots-per-point, or the default.

    Raises:
        ConfigError: the number is below 1, or larger than any machine can hold.
    """
    check_number("--robots-per-point", given, 1, MOST_ROBOTS // MOST_SIZES)
    return given if given is not None else 256 if full else 32


def check_number(flag: str, value: float | None, least: float, most: float, above: bool = False) -> None:
    """Check that a number of the command line, if it is given, is from `least`, or `above` it, to `most`.

    Raises:
        ConfigError: it is not.
    """
    if value is None or (least < value <= most) or (value == least and not above):
        return
    limit = f"at most {most:,}" if value > most else f"above {least:,}" if above else f"at least {least:,}"
    raise ConfigError(f"{flag}: must be {limit}, got {value:,}")
