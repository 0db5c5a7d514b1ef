"""First checkpoint of a run that walks: `legged evaluate checkpoints anymal_c_flat`.

Every checkpoint of the run is measured over the grid of commands. time_to_walk.json says after how many seconds, counted from
the start of the training's process, the first one walked. A small train.runner.save_interval makes the answer finer.
"""

from legged.cli.evaluate.common import add_grid_arguments, check_follows_commands, evaluation_parser, grid_of, ready, settle
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.all_checkpoints import WALKING_FALLS, WALKING_RMSE, check_limits, evaluate_all_checkpoints
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
    parser.add_argument(
        "--rmse",
        type=float,
        default=WALKING_RMSE,
        help=f"largest velocity RMSE of a robot that walks [m/s]; {WALKING_RMSE} by default",
    )
    parser.add_argument(
        "--falls", type=float, default=WALKING_FALLS, help=f"and largest share of falls; {WALKING_FALLS} by default"
    )
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    check_limits(args.rmse, args.falls)
    if args.checkpoint is not None:
        raise ConfigError("--checkpoint: all checkpoints of the run are measured; leave it out")
    setting = settle(args)
    check_follows_commands(setting.policy)
    grid = grid_of(setting, args)
    ready(setting)
    policy, device, graph, folder = setting.policy, setting.device, setting.graph, setting.folder
    return evaluate_all_checkpoints(policy, grid, setting.asked, device, graph, folder, args.rmse, args.falls)
