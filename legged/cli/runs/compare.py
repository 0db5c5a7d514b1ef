"""Several runs side by side: `legged runs compare A B`.

comparison.html and .md show which settings differ, the learning curves over each other, and the evaluations with confidence
intervals. The first run is the reference.
"""

from pathlib import Path

from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.reports.comparison import comparison_parts
from legged.evaluation.reports.document import write_pages
from legged.evaluation.reports.record import read_record
from legged.learning.run_folder import LOGS, own_run
from legged.process.command_parser import CommandParser, add_import_argument
from legged.process.paths import make_folder, ready_to_write, relative
from legged.registry import import_tasks

MOST_COMPARED = 8
"""Largest number of runs, which is the number of colours."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged runs compare",
        __doc__,
        "legged runs compare anymal_c_flat/11-22_s1 anymal_c_flat/11-22_s2",
        "legged runs compare anymal_c_flat go2_flat --out comparison",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="runs or their folders, or tasks, whose newest runs count")
    parser.add_argument("--out", type=Path, default=LOGS, metavar="FOLDER", help=f"folder for the pages; {LOGS}/ by default")
    add_import_argument(parser)
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    if args.module:
        import_tasks(args.module)
    if not 2 <= len(args.runs) <= MOST_COMPARED:
        raise ConfigError(f"RUN: expected 2 to {MOST_COMPARED} runs, got {len(args.runs)}")
    runs = [own_run(name, "RUN") for name in args.runs]
    if len({run.resolve() for run in runs}) < len(runs):
        raise ConfigError(f"RUN: a run comes twice: {', '.join(args.runs)}")
    ready_to_write(args.out, 4.0)
    records = [read_record(run) for run in runs]
    make_folder(args.out)
    page = write_pages(args.out / "comparison", "Comparison", comparison_parts(records))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0
