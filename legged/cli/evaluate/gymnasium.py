"""Returns of a policy in Gymnasium's own environment: `legged evaluate gymnasium half_cheetah`.

The exported policy acts in the environment that the task is modelled on, and Gymnasium counts the returns. The figures are
printed and written to evaluation_gymnasium.json.
"""

from legged.cli.evaluate.common import check_number, evaluation_parser, settle
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.episodes import MOST_EPISODES, evaluate_in_gymnasium
from legged.process.command_parser import CommandParser

EPISODES = 20
"""Default number of episodes."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate gymnasium",
        __doc__,
        "legged evaluate gymnasium half_cheetah",
        "legged evaluate gymnasium half_cheetah --episodes 100",
    )
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"how many; {EPISODES} by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    check_number("--episodes", args.episodes, 1, MOST_EPISODES)
    for option in ("physics", "solver", "sim_device"):
        if getattr(args, option) is not None:
            raise ConfigError(f"--{option.replace('_', '-')}: Gymnasium simulates by itself; leave it out")
    return evaluate_in_gymnasium(settle(args, follows=False), args.episodes)
