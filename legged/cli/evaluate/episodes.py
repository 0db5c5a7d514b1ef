"""Returns and lengths of full episodes: `legged evaluate episodes half_cheetah`.

It measures tasks without velocity commands, in one of the engines of this package. The figures are printed and written to
evaluation_<physics>.json.
"""

from legged.cli.evaluate.common import evaluation_parser, ready, settle
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
    parser.add_argument("--episodes", type=int, default=ENVIRONMENTS, help=f"number of episodes; {ENVIRONMENTS} by default")
    return parser


def check_episodes(count: int) -> None:
    """Check the number of episodes.

    Raises:
        ConfigError: it is out of bounds.
    """
    if not 1 <= count <= MOST_EPISODES:
        limit = "at least 1" if count < 1 else f"at most {MOST_EPISODES:,}"
        raise ConfigError(f"--episodes: must be {limit}, got {count:,}")


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    check_episodes(args.episodes)
    setting = settle(args)
    task = setting.policy.cfg.task
    if isinstance(setting.policy.cfg, LeggedConfig):
        raise ConfigError(f"POLICY: '{task}' follows velocity commands; legged evaluate grid {task} measures how well")
    ready(setting)
    policy, device, graph, folder = setting.policy, setting.device, setting.graph, setting.folder
    return evaluate_episodes(policy, args.episodes, setting.asked, device, graph, folder, setting.where)
