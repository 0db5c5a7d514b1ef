"""Success against the size of terrain: `legged evaluate terrain anymal_c --types stairs_up,gap`.

Robots cross tiles of each terrain type in growing sizes. The share of robots that arrive is printed, drawn to
success_<physics>.png, and written into evaluation_<physics>.json.
"""

from legged.cli.evaluate.common import (
    add_points_arguments,
    add_types_argument,
    check_follows_commands,
    check_points,
    evaluation_parser,
    ready,
    settle,
)
from legged.commandline.command import command
from legged.config import LeggedConfig
from legged.errors import ConfigError
from legged.evaluation.following import evaluate_following
from legged.evaluation.success import chosen_sizes
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate terrain",
        __doc__,
        "legged evaluate terrain anymal_c --physics mujoco",
        "legged evaluate terrain go2 --types stairs_up,slope_up --robots-per-point 64",
    )
    add_types_argument(parser)
    add_points_arguments(parser, "all sizes of a type")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    robots = check_points(args.robots_per_point, args.full)
    setting = settle(args)
    policy = setting.policy
    check_follows_commands(policy)
    assert isinstance(policy.cfg, LeggedConfig)
    sizes = chosen_sizes(policy.cfg, args.types, args.full, setting.judged.terrain.scale)
    if not sizes:
        task = policy.cfg.task
        raise ConfigError(f"POLICY: '{task}' was trained on a plane; --types names the terrain types that it should cross")
    ready(setting)
    return evaluate_following(
        policy, None, sizes, robots, setting.asked, setting.device, setting.graph, setting.folder, setting.where
    )
