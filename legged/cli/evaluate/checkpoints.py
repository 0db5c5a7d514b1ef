"""First checkpoint of a run that walks: `legged evaluate checkpoints anymal_c_flat`.

Every checkpoint of the run is measured over the grid of commands. time_to_walk.json says after how many seconds, counted from
the start of the training's process, the first one walked. A small train.runner.save_interval makes the answer finer.
"""

from legged.cli.evaluate.common import add_grid_arguments, check_number, evaluation_parser, grid_of, settle
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.following import WALKING_FALLS, WALKING_RMSE, evaluate_all_checkpoints
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate checkpoints",
        __doc__,
        "legged evaluate checkpoints anymal_c_flat",
        "legged evaluate checkpoints go1_flat/2026-11-22_05-38-19 --rmse 0.2 --falls 0.01",
    )
    add_grid_arguments(parser)
    rmse = f"largest velocity RMSE of a robot that walks [m/s]; {WALKING_RMSE} by default"
    parser.add_argument("--rmse", type=float, default=WALKING_RMSE, help=rmse)
    falls = f"and largest share of falls; {WALKING_FALLS} by default"
    parser.add_argument("--falls", type=float, default=WALKING_FALLS, help=falls)
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    check_number("--rmse", args.rmse, 0, 100, above=True)
    check_number("--falls", args.falls, 0, 1, above=True)
    if args.checkpoint is not None:
        raise ConfigError("--checkpoint: all checkpoints of the run are measured; leave it out")
    setting = settle(args)
    return evaluate_all_checkpoints(setting, grid_of(setting, args), args.rmse, args.falls)
