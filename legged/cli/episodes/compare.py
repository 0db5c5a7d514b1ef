"""Joint statistics of two policies side by side: `legged episodes compare anymal_c_flat logs/anymal_c_flat/RUN`.

Each is a policy, whose episodes are run for this purpose, or a folder of recorded episodes.
"""

import argparse
from pathlib import Path

import torch

from legged.cli.episodes.common import (
    add_recording_arguments,
    device_of,
    engine_from,
    label_of,
    print_statistics,
    wish_of,
)
from legged.commandline.arguments import POLICY_HELP
from legged.commandline.command import command
from legged.episodes.joint_statistics import check_comparable, joint_statistics
from legged.episodes.rollout import Wish, check_wish, roll_out
from legged.episodes.stored import ABOUT, Episodes, load_episodes
from legged.policies.restore import TrainedPolicy, policy_of
from legged.process.command_parser import CommandParser
from legged.process.paths import exists, ready_to_write
from legged.registry import import_tasks

SOURCE_HELP = f"{POLICY_HELP}, or a folder of recorded episodes"


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged episodes compare",
        __doc__,
        "legged episodes compare anymal_c_flat anymal_c_flat/2026-11-22_05-38-19",
        "legged episodes compare logs/episodes/anymal_c logs/episodes/anymal_c_blind --out comparison",
    )
    parser.add_argument("policy", metavar="POLICY", help=SOURCE_HELP)
    parser.add_argument("other", metavar="POLICY", help="second policy, or folder of recorded episodes")
    add_recording_arguments(parser)
    parser.add_argument("--out", type=Path, help="folder for all files; logs/episodes/compare by default")
    return parser


def source_of(name: str, wish: Wish) -> Episodes | TrainedPolicy:
    """Return the recorded episodes in the folder `name`, or the policy of that name, of which `wish` can be run.

    Raises:
        ConfigError: there is neither, or the wish does not fit the policy.
    """
    if exists(Path(name) / ABOUT):
        return load_episodes(Path(name), "POLICY")
    policy = policy_of(name)
    check_wish(policy, wish)
    return policy


def run_source(source: Episodes | TrainedPolicy, wish: Wish, device: torch.device, args: argparse.Namespace) -> Episodes:
    """Return episodes: those of `source`, or new ones of its policy."""
    if isinstance(source, Episodes):
        return source
    return roll_out(source, wish, device, not args.no_graph, engine_from(args))[0]


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    if args.module:
        import_tasks(args.module)
    wish, device = wish_of(args), device_of(args)
    folder = args.out or Path("logs") / "episodes" / "compare"
    ready_to_write(folder)
    found = {}
    for source in [source_of(name, wish) for name in (args.policy, args.other)]:
        episodes = run_source(source, wish, device, args)
        label = label_of(episodes)
        found[label if label not in found else f"{label} (2)"] = joint_statistics(episodes, "POLICY")
    check_comparable(*found.values())
    print_statistics(folder, found)
    return 0
