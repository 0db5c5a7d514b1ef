"""Learning curves of runs as a picture: `legged runs curves anymal_c_flat`.

learning_curve.png shows tracking error, return and falls over iterations, one line for each run, read from the TensorBoard
files. An axis on top shows the time, unless the runs differ by more than 5 % in the time of an iteration. For runs on terrain
the picture also shows the mean level of each type, and the shares of episodes after which robots moved up and down.
"""

import sys
from pathlib import Path

from legged.commandline.command import run_main
from legged.evaluation.learning_curves import always_promoted, draw_runs, labels, read_config, read_scalars
from legged.learning.run_folder import own_run
from legged.process.command_parser import CommandParser, add_import_argument
from legged.process.paths import make_folder, ready_to_write, relative
from legged.registry import import_tasks

PICTURE = "learning_curve.png"


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged runs curves",
        __doc__,
        "legged runs curves anymal_c_flat/2026-11-22_05-38-19",
        "legged runs curves logs/anymal_c/*_s1 logs/anymal_c/*_s2 --out pictures",
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="runs or their folders, or tasks, whose newest runs count")
    parser.add_argument("--out", type=Path, default=Path("."), help=f"folder for {PICTURE}; the working directory by default")
    add_import_argument(parser)
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    if args.module:
        import_tasks(args.module)
    folders = [own_run(name, "RUN") for name in args.runs]
    ready_to_write(args.out)
    runs = [read_scalars(run) for run in folders]
    configs = [read_config(run) for run in folders]
    named = dict(zip(labels(folders, configs), runs, strict=True))
    make_folder(args.out)
    draw_runs(named, args.out / PICTURE, {level for config in configs if (level := always_promoted(config)) is not None})
    print(f"written: {relative(args.out / PICTURE)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
