"""Velocity errors over a grid of commands: `legged evaluate grid anymal_c_flat --vx=-1:1:0.5`.

Every cell of the grid is one command (vx, vy, yaw rate), which several robots follow. Tables of the errors are printed, and
evaluation_<physics>.json and .png written. With `--physics all` the grid is measured in every engine and solver, and
crossing.json and .png are written.
"""

from legged.cli.evaluate.common import add_grid_arguments, evaluation_parser, grid_of, settle
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.following import EVERYWHERE, cross, evaluate_following
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate grid",
        __doc__,
        "legged evaluate grid anymal_c_flat --vx=-1:1:0.5 --vy=0 --yaw=0",
        "legged evaluate grid go2_flat --physics all --robots 4",
    )
    add_grid_arguments(parser)
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    everywhere = args.physics == EVERYWHERE
    if everywhere:
        args.physics = None
        if args.solver is not None:
            raise ConfigError(f"--solver: --physics {EVERYWHERE} measures in all of them; leave one of the two out")
    setting = settle(args)
    grid = grid_of(setting, args)
    return cross(setting, grid) if everywhere else evaluate_following(setting, grid)
