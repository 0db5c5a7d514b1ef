"""Table and figures of a sweep: `legged sweep report anymal_c_flat`.

table.md, best.yaml and figures of the trials that have ended are written into logs/<name of the sweep>, also while the sweep
runs.
"""

from legged.cli.sweep.run import add_sweep_arguments, devices_of, plan_of
from legged.commandline.command import command
from legged.process.command_parser import CommandParser
from legged.process.paths import ready_to_write
from legged.sweeping.report import write_report
from legged.sweeping.study import Trials


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged sweep report",
        __doc__,
        "legged sweep report anymal_c_flat",
        "legged sweep report cfg/sweeps/anymal_c_flat.yaml --storage journal:sweep.log",
    )
    add_sweep_arguments(parser)
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    plan = plan_of(args, devices_of(args)[0].type == "cpu")
    ready_to_write(plan.folder)
    print(*write_report(Trials(plan, args.storage or ""), args.module), sep="\n")
    return 0
