"""Several runs side by side: `legged runs compare A B`.

comparison.html and .md show which settings differ, the learning curves over each other, and the evaluations with confidence
intervals. The first run is the reference.
"""

from pathlib import Path

from legged.cli.runs import folders_of, runs_parser
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.reports.comparison import comparison_parts
from legged.evaluation.reports.document import write_pages
from legged.evaluation.reports.record import read_record
from legged.learning.run_folder import LOGS
from legged.process.command_parser import CommandParser
from legged.process.paths import make_folder, ready_to_write, relative

MOST_COMPARED = 8
"""Largest number of runs, which is the number of colours."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = runs_parser(
        "compare",
        __doc__,
        "legged runs compare anymal_c_flat/11-22_s1 anymal_c_flat/11-22_s2",
        "legged runs compare anymal_c_flat go2_flat --out comparison",
    )
    parser.add_argument("--out", type=Path, default=LOGS, metavar="FOLDER", help=f"folder for the pages; {LOGS}/ by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    if not 2 <= len(args.runs) <= MOST_COMPARED:
        raise ConfigError(f"RUN: expected 2 to {MOST_COMPARED} runs, got {len(args.runs)}")
    runs = folders_of(args)
    if len({run.resolve() for run in runs}) < len(runs):
        raise ConfigError(f"RUN: a run comes twice: {', '.join(args.runs)}")
    ready_to_write(args.out, 4.0)
    records = [read_record(run) for run in runs]
    make_folder(args.out)
    page = write_pages(args.out / "comparison", "Comparison", comparison_parts(records))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0
