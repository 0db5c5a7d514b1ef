"""Many robots walking, in one picture: `python -m legged.tools.contact_sheet go2_flat h1_flat --out robots.gif`.

Each is shown with the policy of the newest run of its task, else with the one that is shipped; a run folder in place of a
task names another. They walk in C MuJoCo on the CPU. A GIF shows them for four seconds and has at most 2 MB, a PNG is a
picture.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from legged.commandline.command import run_main
from legged.errors import ConfigError
from legged.play.contact_sheet import film, sheet, walker, write_sheet
from legged.policies.restore import TrainedPolicy, policy_of
from legged.process.command_parser import CommandParser, add_import_argument
from legged.process.paths import ready_to_write_file
from legged.registry import import_tasks

SIDE = 176
"""Width and height of a tile, if nobody says how large it is to be [pixels]."""
SMALLEST, LARGEST = 32, 1000
"""Of a tile, as it may be asked for [pixels]."""
ENDINGS = (".gif", ".png")


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "contact_sheet",
        __doc__,
        "python -m legged.tools.contact_sheet anymal_c_flat go2_flat --out robots.gif",
        "python -m legged.tools.contact_sheet logs/go2_flat/2026-11-22_05-38-19 --out go2.png --side 400",
    )
    parser.add_argument(
        "robots",
        nargs="+",
        metavar="TASK | RUN",
        help="tasks, or YAML files of them; run folders, folders of shipped policies",
    )
    parser.add_argument("--out", type=Path, required=True, help="the file, .gif or .png")
    parser.add_argument("--columns", type=int, help="tiles side by side; so many that the sheet is twice as wide as high")
    parser.add_argument("--side", type=int, default=SIDE, help=f"width and height of a tile [pixels]; {SIDE}")
    add_import_argument(parser)
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    ready_to_write_file("--out", args.out, 4.0, ENDINGS)
    if args.columns is not None and args.columns < 1:
        raise ConfigError(f"--columns: must be at least 1, got {args.columns}")
    if not SMALLEST <= args.side <= LARGEST:
        raise ConfigError(f"--side: must be between {SMALLEST} and {LARGEST}, got {args.side}")
    if args.module:
        import_tasks(args.module)
    policies = [policy_of(name, "TASK | RUN") for name in args.robots]
    names = names_of(policies)
    torch.set_num_threads(1)
    tiles = []
    for policy in policies:
        tiles.append(film(policy, args.side))
        print(f"{policy.cfg.task}: {len(tiles[-1])} pictures", flush=True)
    print(write_sheet(sheet(tiles, names, args.columns), args.out))
    return 0


def names_of(policies: Sequence[TrainedPolicy]) -> list[str]:
    """Return what is written below the tiles: the robot; the task where the robot comes twice; the folder of the policy too
    where the task does.

    Raises:
        ConfigError: one of them follows no commands, so that it can't be asked to walk.
    """
    robots = [Path(walker(policy, "TASK | RUN: ").robot).name for policy in policies]
    tasks = [policy.cfg.task for policy in policies]
    names = []
    for robot, task, policy in zip(robots, tasks, policies, strict=True):
        known = robot if robots.count(robot) == 1 else task
        names.append(known if tasks.count(task) == 1 else f"{task} {policy.folder.name}")
    return names


if __name__ == "__main__":
    sys.exit(main())
