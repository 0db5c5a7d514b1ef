"""Returns and lengths of full episodes: `legged evaluate episodes half_cheetah`.

It measures tasks without velocity commands, in one of the engines of this package. The figures are printed and written to
evaluation_<physics>.json.
"""

from legged.cli.evaluate.common import check_number, evaluation_parser, settle
from legged.commandline.command import command
from legged.config import LeggedConfig
from legged.errors import ConfigError
from legged.evaluation.episodes import MOST_EPISODES, evaluate_episodes
from legged.process.command_parser import CommandParser

ENVIRONMENTS = 256
"""Default number of episodes, each in an environment of its own."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate episodes",
        __doc__,
        "legged evaluate episodes half_cheetah",
        "legged evaluate episodes humanoid --episodes 64 --physics mujoco",
    )
    parser.add_argument("--episodes", type=int, default=ENVIRONMENTS, help=f"how many; {ENVIRONMENTS} by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    check_number("--episodes", args.episodes, 1, MOST_EPISODES)
    setting = settle(args, follows=False)
    if isinstance(setting.policy.cfg, LeggedConfig):
        task = setting.policy.cfg.task
        raise ConfigError(f"POLICY: '{task}' follows velocity commands; legged evaluate grid {task} measures how well")
    return evaluate_episodes(setting, args.episodes)
