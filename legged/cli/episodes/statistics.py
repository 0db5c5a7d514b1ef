"""Mean and standard deviation of every joint: `legged episodes statistics anymal_c_flat --episodes 50`.

The numbers are those of episodes that are run for this purpose, or of recorded ones if a folder is named.
"""

import argparse
from pathlib import Path

from rich.console import Console

from legged.cli.episodes.common import add_recording_arguments, run_episodes, wish_of
from legged.commandline.arguments import POLICY_HELP
from legged.commandline.command import command
from legged.episodes.joint_statistics import joint_statistics, tables_of, write_statistics
from legged.episodes.recorder import check_wish
from legged.episodes.stored import ABOUT, Episodes, load_episodes
from legged.evaluation.reports.document import text_of
from legged.policies.restore import policy_of
from legged.process.command_parser import CommandParser
from legged.process.paths import exists, ready_to_write
from legged.registry import import_tasks
from legged.tables import screen_table


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged episodes statistics",
        __doc__,
        "legged episodes statistics anymal_c_flat --episodes 50",
        "legged episodes statistics logs/episodes/anymal_c",
    )
    add_source_arguments(parser, Path("logs/episodes/statistics"), "policy")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    return report(args, args.policy)


def add_source_arguments(parser: CommandParser, folder: Path, *names: str) -> None:
    """Add arguments that name policies or recordings, the options of a recording, and --out, `folder` by default."""
    for name in names:
        says = f"{POLICY_HELP}, or a folder of recorded episodes" if name == "policy" else "the other one"
        parser.add_argument(name, metavar="POLICY", help=says)
    add_recording_arguments(parser)
    parser.add_argument("--out", type=Path, default=folder, help=f"folder for all files; {folder.as_posix()} by default")


def report(args: argparse.Namespace, *names: str) -> int:
    """Print the joint statistics of policies or recordings, write them into the folder --out, and return 0.

    Raises:
        ConfigError: there is no such policy, an option does not fit it, or two policies have other joints.
    """
    if args.module:
        import_tasks(args.module)
    wish = wish_of(args)
    ready_to_write(args.out)
    sources = []
    for name in names:  # all are checked before anything is built
        recorded = exists(Path(name) / ABOUT)
        sources.append(load_episodes(Path(name), "POLICY") if recorded else policy_of(name))
        if not isinstance(sources[-1], Episodes):
            check_wish(sources[-1], wish)
    found = {}
    for source in sources:
        episodes = source if isinstance(source, Episodes) else run_episodes(source, wish, args)[0]
        run = str(episodes.about.get("run", episodes.about["task"])).split("/")
        label = f"{run[-1]} (shipped)" if "policies" in run else "/".join([*run[-2:], episodes.about["checkpoint"]])
        found[label if label not in found else f"{label} (2)"] = joint_statistics(episodes)
    console = Console(width=130)
    for title, table in tables_of(found).items():
        heads = [head.replace(", ", ",\n") for head in table.head]
        console.print(screen_table(title, heads, [[text_of(cell) for cell in row] for row in table.rows]))
    write_statistics(args.out, found)
    return 0
