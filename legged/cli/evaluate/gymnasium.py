"""Returns of a policy in Gymnasium's own environment: `legged evaluate gymnasium half_cheetah`.

The exported policy acts in the environment that the task is modelled on, and Gymnasium counts the returns. The figures are
printed and written to evaluation_gymnasium.json.
"""

from legged.cli.evaluate.common import evaluation_parser, ready, settle
from legged.cli.evaluate.episodes import check_episodes
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.gymnasium_episodes import EPISODES, environment_of, evaluate_in_gymnasium
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate gymnasium",
        __doc__,
        "legged evaluate gymnasium half_cheetah",
        "legged evaluate gymnasium half_cheetah --episodes 100",
    )
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"number of episodes; {EPISODES} by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    check_episodes(args.episodes)
    for option in ("physics", "solver", "sim_device"):
        if getattr(args, option) is not None:
            raise ConfigError(f"--{option.replace('_', '-')}: Gymnasium simulates by itself; leave it out")
    setting = settle(args)
    environment_of(setting.policy.cfg.task)
    ready(setting)
    return evaluate_in_gymnasium(setting.policy, args.episodes, setting.overrides, setting.folder)
