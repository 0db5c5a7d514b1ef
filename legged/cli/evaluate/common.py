"""Arguments and set-up that the sub-commands of `legged evaluate` share."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from legged.commandline.arguments import add_policy_arguments, pick_device, policy_overrides, register_given, settle_on
from legged.config import LeggedConfig, override
from legged.errors import ConfigError
from legged.evaluation.result_file import CHANGED, changes_of
from legged.evaluation.success import TYPES_HELP
from legged.evaluation.velocity_grid import AXES, MOST_ROBOTS, Grid, axes_of, axis_values, check_size
from legged.physics import resolve_physics
from legged.policies.restore import TrainedPolicy, policy_of
from legged.process.command_parser import CommandParser
from legged.process.paths import ready_to_write

ROBOTS = 16
"""Default number of robots for each cell of the grid."""
MOST_SIZES = 16
"""Largest number of sizes of a terrain type that are measured at the same time."""


@dataclass(frozen=True)
class Setting:
    """A policy to measure, with its overrides and its folder."""

    policy: TrainedPolicy
    device: torch.device
    graph: bool
    overrides: list[tuple[str, Any]]
    """Overrides of the command line."""
    folder: Path
    """Folder of the result."""
    where: str
    """The argument that names the engine, for errors."""

    @property
    def asked(self) -> list[tuple[str, Any]]:
        """The overrides, with the engine of the device in place of the training's."""
        return [("sim.physics", resolve_physics("auto", self.device)), *self.overrides]

    @property
    def judged(self) -> LeggedConfig:
        """The policy's configuration with the overrides."""
        return override(self.policy.cfg, self.overrides)  # type: ignore[return-value]


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
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"robots for each cell; {ROBOTS} by default")


def add_points_arguments(parser: argparse.ArgumentParser, full: str) -> None:
    """Add the options for the number of robots at each size of a terrain type; `full` is the help of --full."""
    parser.add_argument("--full", action="store_true", help=f"{full}, and 256 robots each")
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a type; 32, or 256 with --full")


def add_types_argument(parser: argparse.ArgumentParser) -> None:
    """Add --types, which chooses terrain types and sizes."""
    parser.add_argument("--types", help=TYPES_HELP)


def settle(args: argparse.Namespace) -> Setting:
    """Return the setting of a command line.

    Raises:
        ConfigError: there is no such policy or device, or the folder cannot be written.
    """
    register_given(args, "policy")
    if args.num_envs is not None:
        raise ConfigError("--num-envs: the evaluation chooses the number of robots; leave it out")
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    policy = policy_of(args.policy, getattr(args, "checkpoint", None))
    overrides = policy_overrides(args)
    own = policy.output("evaluate")
    folder = args.out or (own / CHANGED if changes_of(overrides) else own)
    where = "--physics" if args.physics else "sim.physics"
    return Setting(policy, device, not args.no_graph, overrides, folder, where)


def ready(setting: Setting) -> None:
    """Check that the result can be written.

    Raises:
        ConfigError: it cannot.
    """
    ready_to_write(setting.folder)


def check_follows_commands(policy: TrainedPolicy) -> None:
    """Check that a policy's task has velocity commands.

    Raises:
        ConfigError: it has none.
    """
    if not isinstance(policy.cfg, LeggedConfig):
        task = policy.cfg.task
        raise ConfigError(f"POLICY: '{task}' has no velocity commands; legged evaluate episodes {task} measures its returns")


def grid_of(setting: Setting, args: argparse.Namespace | None = None) -> Grid:
    """Return the grid of commands from the options, or from the configuration for options that are not given.

    Raises:
        ConfigError: an axis is malformed, or the grid is too large.
    """
    axes = axes_of(setting.judged)
    robots = ROBOTS
    if args is not None:
        texts = {axis: getattr(args, axis) for axis in AXES}
        axes = {**axes, **{axis: axis_values(f"--{axis}", text) for axis, text in texts.items() if text is not None}}
        robots = args.robots
    grid = Grid(axes["vx"], axes["vy"], axes["yaw"], robots)
    check_size(grid)
    return grid


def check_points(given: int | None, full: bool) -> int:
    """Return the number of robots for each size of a terrain type: `given` by --robots-per-point, or the default.

    Raises:
        ConfigError: the number is below 1, or larger than any machine can hold.
    """
    a_point = given if given is not None else (256 if full else 32)
    if not 1 <= a_point <= MOST_ROBOTS // MOST_SIZES:
        limit = "at least 1" if a_point < 1 else f"at most {MOST_ROBOTS // MOST_SIZES:,}"
        raise ConfigError(f"--robots-per-point: must be {limit}, got {a_point:,}")
    return a_point
