"""Evaluation files side by side: `legged runs evaluations logs/anymal_c/RUN logs/anymal_c/RUN`.

Evaluations of one task in one engine count as its seeds: the tables give their mean and the largest deviation from it, the
picture their mean and range. Evaluations with other fields changed, or on another grid of commands, are kept apart.
"""

from pathlib import Path

from rich.console import Console

from legged.commandline.command import command
from legged.errors import ConfigError
from legged.evaluation.reports.comparison import (
    Evaluations,
    draw_comparison,
    episodes_comparison,
    grouped,
    keep_types,
    success_table,
    tracking_table,
)
from legged.evaluation.result_file import has_tracking, read_results
from legged.evaluation.success import types_in
from legged.process.command_parser import CommandParser
from legged.process.paths import make_folder, ready_to_write, relative


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged runs evaluations",
        __doc__,
        "legged runs evaluations logs/anymal_c_flat/2026-11-22_05-38-19 logs/anymal_c_flat/2026-11-22_06-02-41",
        "legged runs evaluations logs/anymal_c/*/evaluation_mujoco.json --types stairs_up,slope_up --out pictures",
    )
    parser.add_argument(
        "paths", nargs="+", type=Path, metavar="PATH", help="evaluation_<physics>.json files, or folders that hold them"
    )
    parser.add_argument("--types", help="terrain types to show, e.g. stairs_up,slope_up; all by default")
    parser.add_argument("--out", type=Path, help="folder for success.png, a picture of success against difficulty")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    if args.out:
        ready_to_write(args.out)
    results = read_results(args.paths)
    if args.types:
        keep_types(results, [name.strip() for name in args.types.split(",")])
    episodes: Evaluations = {}
    following: Evaluations = {}
    for key, seeds in grouped(results).items():
        of_episodes = {"episodes" in result for result in seeds}
        if len(of_episodes) > 1:
            told = "some evaluations are of commands, others of episodes; compare them apart"
            raise ConfigError(f"{key[0]} in {key[1]}: {told}")
        (episodes if of_episodes.pop() else following)[key] = seeds
    tracked = {key: seeds for key, seeds in following.items() if any(map(has_tracking, seeds))}
    with_success = {key: seeds for key, seeds in following.items() if any(map(types_in, seeds))}
    console = Console(width=130)
    for groups, table in ((tracked, tracking_table), (episodes, episodes_comparison), (with_success, success_table)):
        if groups:
            console.print(table(groups))
    if args.out:
        if not with_success:
            raise ConfigError("--out: draws success against difficulty, and none of the evaluations holds that")
        make_folder(args.out)
        draw_comparison(with_success, args.out / "success.png")
        print(f"written: {relative(args.out / 'success.png')}")
    return 0
