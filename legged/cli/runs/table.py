"""All runs in one table: `legged runs`.

Every run in logs/, or in the folders given, becomes a row of experiments.html and experiments.md, newest first. On the page a
click on a column sorts and a field filters. `--seeds-share` makes one row of the seeds of a training.
"""

from pathlib import Path

from legged.cli.main import hint_at_sub_command
from legged.commandline.command import command
from legged.evaluation.reports.document import to_html, to_markdown
from legged.evaluation.reports.experiments import TITLE, experiments_parts
from legged.evaluation.reports.record import folders_in, read_record
from legged.learning.run_folder import LOGS
from legged.process.command_parser import CommandParser, add_import_argument
from legged.process.paths import exists, make_folder, ready_to_write, relative, write_text
from legged.registry import import_tasks


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged runs", __doc__, "legged runs", "legged runs logs/anymal_c_flat logs/go2_flat --seeds-share"
    )
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help=f"folders of runs; {LOGS}/ by default")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help=f"folder for the pages; {LOGS}/, or the first one given")
    parser.add_argument("--seeds-share", action="store_true", help="one row of means for runs that differ in their seed only")
    add_import_argument(parser)
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    if args.module:
        import_tasks(args.module)
    folder: Path = args.out or (args.folders[0] if args.folders else LOGS)
    if exists(folder) or args.out is not None:  # `folders_in` reports a missing folder of runs
        ready_to_write(folder, 4.0)
    with hint_at_sub_command("runs", list(map(str, args.folders))):
        found = {run.resolve(): run for given in args.folders or [LOGS] for run in folders_in(given)}
    records = [read_record(run) for run in found.values()]
    make_folder(folder)
    parts = {ending: experiments_parts(records, folder, ending, args.seeds_share) for ending in ("md", "html")}
    write_text(folder / "experiments.md", to_markdown(TITLE, parts["md"], "experiments"))
    page = folder / "experiments.html"
    write_text(page, to_html(TITLE, parts["html"]))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0
