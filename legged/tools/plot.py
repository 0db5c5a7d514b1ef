"""Learning curves of runs: `python -m legged.tools.plot logs/anymal_c_flat/<run> [<run> ...] --out curve.png`.

Reads the TensorBoard files and draws returns, errors, falls and metrics over iterations, one line a run. A second axis shows
the time if the iterations of all runs take equally long within 5 %. Runs on terrain add the mean level of each type and the
shares of episodes after which robots moved up and down, as means over the runs.
"""

import sys
from pathlib import Path

from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser
from legged.errors import ConfigError
from legged.evaluation.learning_curves import Log, common_time, labels, read_config, read_scalars
from legged.evaluation.reports.charts import draw_charts
from legged.evaluation.reports.curves import levels, outcomes
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
    logs = [Log(read_scalars(run), read_config(run)) for run in args.runs]
    runs = list(zip(labels(args.runs, [log.config for log in logs]), logs, strict=True))
    charts = [*outcomes(runs), *levels(logs)]
    if not charts:
        raise ConfigError(f"{args.runs[0]}: its TensorBoard file holds no returns, errors or metrics")
    draw_charts(charts, args.out, iteration_s=common_time([log.scalars for log in logs]))
    print(f"written: {relative(args.out)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
