"""Success against the size of terrain: `legged evaluate terrain anymal_c --types stairs_up,gap`.

Robots cross tiles of each terrain type in growing sizes. The share of robots that arrive is printed, drawn to
success_<physics>.png, and written into evaluation_<physics>.json.
"""

from legged.cli.evaluate.common import add_points_arguments, check_points, evaluation_parser, settle
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.following import evaluate_following
from legged.evaluation.success import TYPES_HELP, chosen_sizes
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate terrain",
        __doc__,
        "legged evaluate terrain anymal_c --physics mujoco",
        "legged evaluate terrain go2 --types stairs_up,slope_up --robots-per-point 64",
    )
    parser.add_argument("--types", help=TYPES_HELP)
    add_points_arguments(parser, "all sizes of a type")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    robots = check_points(args.robots_per_point, args.full)
    setting = settle(args)
    cfg = setting.policy.cfg
    sizes = chosen_sizes(cfg, args.types, args.full, setting.cfg.terrain.scale)  # type: ignore[arg-type]
    if not sizes:
        raise ConfigError(
            f"POLICY: '{cfg.task}' was trained on a plane; --types names the terrain types that it should cross"
        )
    return evaluate_following(setting, None, sizes, robots)
