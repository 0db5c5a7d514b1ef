"""Mean and standard deviation of every joint: `legged episodes statistics anymal_c_flat --episodes 50`.

The numbers are those of episodes that are run for this purpose, or of recorded ones if a folder is named.
"""

from pathlib import Path

from legged.cli.episodes.common import add_recording_arguments, device_of, label_of, print_statistics, wish_of
from legged.cli.episodes.compare import SOURCE_HELP, run_source, source_of
from legged.commandline.command import command
from legged.episodes.joint_statistics import joint_statistics
from legged.process.command_parser import CommandParser
from legged.process.paths import ready_to_write
from legged.registry import import_tasks


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged episodes statistics",
        __doc__,
        "legged episodes statistics anymal_c_flat --episodes 50",
        "legged episodes statistics logs/episodes/anymal_c",
    )
    parser.add_argument("policy", metavar="POLICY", help=SOURCE_HELP)
    add_recording_arguments(parser)
    parser.add_argument("--out", type=Path, help="folder for all files; logs/episodes/statistics by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    if args.module:
        import_tasks(args.module)
    wish, device = wish_of(args), device_of(args)
    folder = args.out or Path("logs") / "episodes" / "statistics"
    ready_to_write(folder)
    episodes = run_source(source_of(args.policy, wish), wish, device, args)
    print_statistics(folder, {label_of(episodes): joint_statistics(episodes)})
    return 0
