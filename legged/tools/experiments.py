"""All runs in one table: `python -m legged.tools.experiments`, or some of them side by side: `--compare A B`.

Looks for runs in logs/, or in the folders given, and writes experiments.md and experiments.html there, newest first; the page
sorts by a click on a column and filters by words; `--seeds_share` makes one row of the seeds of a training. With `--compare`,
comparison.md and .html have what two or more runs set otherwise, their curves over each other, and their evaluations with
confidence intervals. Runs are named by folder, or as <experiment>/<run> below logs/.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser, add_import_argument
from legged.errors import ConfigError, suggest
from legged.evaluation.reports.comparison import comparison_parts
from legged.evaluation.reports.document import Part, to_html, to_markdown, write_pages
from legged.evaluation.reports.experiments import TITLE, experiments_parts
from legged.evaluation.reports.record import folders_in, read_record
from legged.learning.run_folder import CONFIG_FILE, LOGS
from legged.process.paths import exists, make_folder, ready_to_write, ready_to_write_file, relative, write_text
from legged.registry import import_tasks

MOST_COMPARED = 8
"""Runs side by side: there are so many colours."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "experiments",
        __doc__,
        "python -m legged.tools.experiments",
        "python -m legged.tools.experiments --compare logs/anymal_c_flat/11-22_s1 logs/go2_flat/11-22_s1",
    )
    parser.add_argument("folders", nargs="*", type=Path, help=f"folders of runs; {LOGS}/ by default")
    parser.add_argument(
        "--compare", nargs="+", metavar="RUN", help="only these runs, side by side; the first is the reference"
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help=f"folder for the pages; {LOGS}/, or the first one given")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write nothing but the Markdown page, as this file")
    parser.add_argument(
        "--seeds_share", action="store_true", help="a row of means for runs that differ in nothing but their seed"
    )
    add_import_argument(parser)
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    if args.module:
        import_tasks(args.module)
    folder: Path = args.out or (args.folders[0] if args.folders else LOGS)
    if args.markdown is not None:
        if args.out is not None:
            raise ConfigError(f"--out: '{args.out}' beside --markdown, which says where its only page goes")
        ready_to_write_file("--markdown", args.markdown)
    elif exists(folder) or args.out is not None:  # no logs/ at all is told by what looks for runs there
        ready_to_write(folder, 4.0)
    if args.compare is not None:
        return _compare(args, folder)
    found = {run.resolve(): run for given in args.folders or [LOGS] for run in folders_in(given)}
    records = [read_record(run) for run in found.values()]
    if args.markdown is not None:
        return _only_markdown(args.markdown, TITLE, experiments_parts(records, args.markdown.parent, "md", args.seeds_share))
    make_folder(folder)
    parts = {ending: experiments_parts(records, folder, ending, args.seeds_share) for ending in ("md", "html")}
    write_text(folder / "experiments.md", to_markdown(TITLE, parts["md"], "experiments"))
    page = folder / "experiments.html"
    write_text(page, to_html(TITLE, parts["html"]))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0


def _only_markdown(path: Path, title: str, parts: Sequence[Part]) -> int:
    """Write a page as one Markdown file; return the exit code."""
    make_folder(path.parent)
    write_text(path, to_markdown(title, parts, path.stem))
    print(f"written: {relative(path)}")
    return 0


def _compare(args: argparse.Namespace, folder: Path) -> int:
    """Write the page on some runs side by side; return the exit code."""
    if args.folders:
        raise ConfigError(f"--compare: names all runs itself; leave out '{args.folders[0]}'")
    if args.markdown is not None:
        raise ConfigError("--markdown: a comparison has pictures beside it; --out says which folder they go to")
    if not 2 <= len(args.compare) <= MOST_COMPARED:
        raise ConfigError(f"--compare: expected 2 to {MOST_COMPARED} runs, got {len(args.compare)}")
    runs = [_named(name) for name in args.compare]
    if len({run.resolve() for run in runs}) < len(runs):
        raise ConfigError(f"--compare: a run comes twice: {', '.join(args.compare)}")
    records = [read_record(run) for run in runs]
    make_folder(folder)
    page = write_pages(folder / "comparison", "Comparison", comparison_parts(records))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0


def _named(name: str) -> Path:
    """Return the run folder of that name.

    Raises:
        ConfigError: there is none.
    """
    for folder in (Path(name), LOGS / name):
        if exists(folder / CONFIG_FILE):
            return folder
    known = [f"{path.parent.parent.name}/{path.parent.name}" for path in LOGS.glob(f"*/*/{CONFIG_FILE}")]
    raise ConfigError(f"--compare: there is no run '{name}'{suggest(name, known, 'runs')}")


if __name__ == "__main__":
    sys.exit(main())
