"""Learning curves of runs: `python -m legged.tools.plot logs/anymal_c_flat/<run> [<run> ...] --out curve.png`.

Reads the TensorBoard files; draws tracking error, return and falls over iterations, one line a run, and an axis of time on
top, unless runs differ in the time of an iteration by more than 5 %. Of runs on terrain, also the mean level of each type and
the shares of episodes after which robots moved up and down, as means over the runs.
"""

import sys
from pathlib import Path

from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser
from legged.evaluation.learning_curves import always_promoted, draw_runs, labels, read_config, read_scalars
from legged.process.paths import ready_to_write_file, relative


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "plot",
        __doc__,
        "python -m legged.tools.plot logs/anymal_c_flat/2026-11-22_05-38-19",
        "python -m legged.tools.plot logs/anymal_c/*_s1 logs/anymal_c/*_s2 --out seeds.png",
    )
    parser.add_argument("runs", nargs="+", type=Path, help="run folders")
    parser.add_argument("--out", type=Path, default=Path("learning_curve.png"), help="PNG file")
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    ready_to_write_file("--out", args.out, endings=(".png",))
    runs = [read_scalars(run) for run in args.runs]
    configs = [read_config(run) for run in args.runs]
    named = dict(zip(labels(args.runs, configs), runs, strict=True))
    draw_runs(named, args.out, {level for config in configs if (level := always_promoted(config)) is not None})
    print(f"written: {relative(args.out)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
