"""Time until a training begins: `legged benchmark startup anymal_c_flat`.

A training is started in a process of its own and ended after its first iteration. The seconds at which each stage of the
start ended are printed, next to those that `import torch` alone takes.
"""

import sys

from legged.benchmarks.start_times import start_report, time_start
from legged.cli.benchmark.common import add_arguments, settle, write
from legged.commandline.command import command
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged benchmark startup",
        __doc__,
        "legged benchmark startup anymal_c_flat",
        "legged benchmark startup go2 --repeats 3 --out times",
    )
    add_arguments(parser)
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    settle(args)
    times = time_start(sys.argv[1:] if argv is None else argv, args.repeats)
    print(start_report(times), flush=True)
    write(args, times)
    return 0
