"""Learning curves of runs as a picture: `legged runs curves anymal_c_flat`.

learning_curve.png shows returns, errors, falls and metrics over iterations, one line for each run, read from the TensorBoard
files. An axis on top shows the time, unless the runs differ by more than 5 % in the time of an iteration. For runs on terrain
the picture also shows the mean level of each type, and the shares of episodes after which robots moved up and down.
"""

from pathlib import Path

from legged.cli.runs import folders_of, runs_parser
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.learning_curves import Log, common_time, labels, levels, outcomes, read_config, read_scalars
from legged.evaluation.reports.charts import draw_charts
from legged.process.command_parser import CommandParser
from legged.process.paths import make_folder, ready_to_write, relative

PICTURE = "learning_curve.png"


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = runs_parser(
        "curves",
        __doc__,
        "legged runs curves anymal_c_flat/2026-11-22_05-38-19",
        "legged runs curves logs/anymal_c/*_s1 logs/anymal_c/*_s2 --out pictures",
    )
    parser.add_argument("--out", type=Path, default=Path("."), help=f"folder for {PICTURE}; the working directory by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    folders = folders_of(args)
    ready_to_write(args.out)
    logs = [Log(read_scalars(run), read_config(run)) for run in folders]
    runs = list(zip(labels(folders, [log.config for log in logs]), logs, strict=True))
    charts = [*outcomes(runs), *levels(logs)]
    if not charts:
        raise ConfigError(f"{relative(folders[0])}: its TensorBoard file holds no returns, errors or metrics")
    make_folder(args.out)
    draw_charts(charts, args.out / PICTURE, iteration_s=common_time([log.scalars for log in logs]))
    print(f"written: {relative(args.out / PICTURE)}")
    return 0
