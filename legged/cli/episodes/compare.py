"""Joint statistics of two policies side by side: `legged episodes compare anymal_c_flat logs/anymal_c_flat/RUN`.

Each is a policy, whose episodes are run for this purpose, or a folder of recorded episodes.
"""

from pathlib import Path

from legged.cli.episodes.statistics import add_source_arguments, report
from legged.commandline.command import command
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged episodes compare",
        __doc__,
        "legged episodes compare anymal_c_flat anymal_c_flat/2026-11-22_05-38-19",
        "legged episodes compare logs/episodes/anymal_c logs/episodes/anymal_c_blind --out comparison",
    )
    add_source_arguments(parser, Path("logs/episodes/compare"), "policy", "other")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    return report(args, args.policy, args.other)
