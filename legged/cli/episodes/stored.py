"""List recorded episodes and make pages of them: `legged episodes list logs/episodes/anymal_c --page 7,12`.

Nothing is simulated: the folder holds what `legged episodes record` has written.
"""

from pathlib import Path

from legged.cli.episodes.common import add_listing_arguments, check_listing, show
from legged.commandline.command import command
from legged.episodes.stored import load_config, load_episodes, save_episodes
from legged.process.command_parser import CommandParser, add_import_argument
from legged.process.paths import ready_to_write
from legged.registry import import_tasks


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged episodes list",
        __doc__,
        "legged episodes list logs/episodes/anymal_c --page 7,12",
        "legged episodes list logs/episodes/anymal_c --sort torque --top 20",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of recorded episodes")
    add_import_argument(parser)
    add_listing_arguments(parser)
    parser.add_argument("--out", type=Path, help="folder for all files; that of the episodes by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    check_listing(args)
    if args.module:
        import_tasks(args.module)
    episodes, folder = load_episodes(args.folder, "FOLDER"), args.out or args.folder
    ready_to_write(folder, 8.0)
    if folder != args.folder:
        save_episodes(episodes, load_config(args.folder, "FOLDER"), folder)
    show(episodes, folder, args)
    return 0
