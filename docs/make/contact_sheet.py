"""Many robots walking in one picture: `python docs/make/contact_sheet.py go2_flat h1_flat --out robots.gif`.

Each tile shows the policy of a task's newest run, or else the task's shipped policy. A run folder in place of a task names
another policy. The robots walk in C MuJoCo on the CPU. A GIF lasts four seconds and has at most 2 MB. A PNG is the picture
in its middle.
"""

import sys
from collections.abc import Sequence
from math import ceil, sqrt
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from legged.commandline.arguments import IMPORT
from legged.commandline.command import run_main
from legged.deploy.command_parser import CommandParser, check_between, check_number
from legged.errors import ConfigError
from legged.play.films import Film, film, walker, write_film
from legged.policies.restore import TrainedPolicy, policy_of
from legged.process.paths import ready_to_write
from legged.registry import import_tasks
from legged.rendering.camera import INK

SIDE = 176
"""Width and height of a tile without --side [pixels]."""
SMALLEST, LARGEST = 32, 1000
"""Limits of --side [pixels]."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "contact_sheet",
        __doc__,
        "python docs/make/contact_sheet.py anymal_c_flat go2_flat --out robots.gif",
        "python docs/make/contact_sheet.py logs/go2_flat/2026-11-22_05-38-19 --out go2.png --side 400",
    )
    parser.add_argument("robots", nargs="+", metavar="TASK | RUN", help="tasks, their YAML files, or folders of policies")
    parser.add_argument("--out", type=Path, required=True, help="the file, .gif or .png")
    parser.add_argument("--columns", type=int, help="tiles in a row; by default the sheet is about twice as wide as high")
    parser.add_argument("--side", type=int, default=SIDE, help=f"width and height of a tile [pixels]; {SIDE}")
    IMPORT(parser)
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    if args.out.suffix not in (".gif", ".png"):
        raise ConfigError(f"--out: must end in .gif or .png, got '{args.out.name}'")
    if args.out.is_dir():
        raise ConfigError(f"--out: {args.out} is a folder; expected a file")
    ready_to_write(args.out.parent, 4.0)
    check_number("--columns", args.columns, 1)
    check_between("--side", args.side, SMALLEST, LARGEST)
    if args.module:
        import_tasks(args.module)
    policies = [policy_of(name, where="TASK | RUN") for name in args.robots]
    names = names_of(policies)
    torch.set_num_threads(1)
    films = []
    for policy in policies:
        films.append(film(policy, args.side))
        print(f"{policy.cfg.task}: {len(films[-1])} pictures", flush=True)
    print(write_film(sheet(films, names, args.columns), args.out))
    return 0


def names_of(policies: Sequence[TrainedPolicy]) -> list[str]:
    """Return the labels of the tiles: the robot, or the task if the robot comes twice, or task and folder if the task does.

    Raises:
        ConfigError: a policy follows no commands.
    """
    robots = [Path(walker(policy, "TASK | RUN: ").robot).name for policy in policies]
    tasks = [policy.cfg.task for policy in policies]
    names = []
    for robot, task, policy in zip(robots, tasks, policies, strict=True):
        known = robot if robots.count(robot) == 1 else task
        names.append(known if tasks.count(task) == 1 else f"{task} {policy.folder.name}")
    return names


def sheet(films: Sequence[Film], names: Sequence[str], columns: int | None = None) -> Film:
    """Put films into tiles, each with its name below; the result is as long as the shortest film.

    Without `columns` the sheet is about twice as wide as high.
    """
    columns = min(len(films), columns or ceil(sqrt(2 * len(films))))
    rows = ceil(len(films) / columns)
    side = films[0][0].shape[0]
    font = ImageFont.load_default(size=max(10, side // 12))
    step = side + max(14, side // 8)
    pictures = []
    for k in range(min(map(len, films))):
        picture = Image.new("RGB", (columns * side, rows * step), "white")
        draw = ImageDraw.Draw(picture)
        for i, (tile, name) in enumerate(zip(films, names, strict=True)):
            x, y = i % columns * side, i // columns * step
            picture.paste(Image.fromarray(tile[k]), (x, y))
            draw.text((x + side // 2, y + (side + step) // 2), name, fill=INK, font=font, anchor="mm")
        pictures.append(np.asarray(picture))
    return pictures


if __name__ == "__main__":
    sys.exit(main())
