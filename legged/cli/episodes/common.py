"""Arguments and work that the sub-commands of `legged episodes` share."""

import argparse
from pathlib import Path

import torch
from rich.console import Console

from legged.commandline.arguments import add_build_arguments, pick_device, policy_overrides, settle_on
from legged.episodes.film import Projector
from legged.episodes.joint_statistics import JointStatistics
from legged.episodes.page import write_page
from legged.episodes.parquet import check_parquet, write_parquet
from legged.episodes.ranking import (
    COLUMNS,
    FELL,
    Figures,
    counts_text,
    figures_of,
    heads_of,
    order_of,
    row_of,
)
from legged.episodes.rollout import MOST_EPISODES, Wish
from legged.episodes.statistics_report import tables_of, write_statistics
from legged.episodes.stored import Episodes, load_config
from legged.errors import ConfigError, suggest
from legged.evaluation.reports.document import text_of
from legged.evaluation.tables import markdown_table, screen_table
from legged.policies.restore import TrainedPolicy
from legged.process.paths import relative, write_text

EPISODES, MOST_ROBOTS = 50, 256
"""Default number of episodes, and largest default number of robots for them."""
TOP = 10
"""Default number of listed episodes."""
LIST = "episodes.md"


def add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the recording."""
    add_build_arguments(parser)
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"number of episodes; {EPISODES} by default")
    parser.add_argument("--as-trained", action="store_true", help="with noise, pushes, randomisation and curricula")
    parser.add_argument("--command", metavar="VX,VY,YAW", help="the command, held throughout [m/s, m/s, rad/s]")
    parser.add_argument("--terrain", metavar="TYPE", help="type of a few tiles, e.g. stairs_up, in place of the training's")
    parser.add_argument("--difficulty", type=float, help="difficulty of such tiles, 0 to 1; 0.5 and 0.8 by default")


def add_listing_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the list of episodes and their pages."""
    known = f"{FELL}, {', '.join(column.name for column in COLUMNS)}"
    parser.add_argument("--sort", default=FELL, help=f"{known}; the worst first")
    parser.add_argument("--ended", metavar="TERM", help="only episodes that this termination ended")
    parser.add_argument("--top", type=int, default=TOP, help=f"episodes to list; {TOP} by default")
    parser.add_argument("--page", metavar="IDS", help="episodes to make pages of, by number: 3 or 3,17")
    parser.add_argument("--worst", type=int, default=0, help="number of episodes at the top of the list that get a page")
    parser.add_argument("--parquet", action="store_true", help="also write one flat table in Parquet; needs pyarrow")


def wish_of(args: argparse.Namespace) -> Wish:
    """Return the settings of the recording.

    Raises:
        ConfigError: a number is out of bounds, or the command is malformed.
    """
    for option, value in (("episodes", args.episodes), ("num-envs", args.num_envs)):
        if value is not None and not 1 <= value <= MOST_EPISODES:
            limit = "at least 1" if value < 1 else f"at most {MOST_EPISODES:,}"
            raise ConfigError(f"--{option}: must be {limit}, got {value:,}")
    robots = args.num_envs if args.num_envs is not None else min(args.episodes, MOST_ROBOTS)
    if robots > args.episodes:
        raise ConfigError(f"--num-envs: {robots} robots have no more than {args.episodes} episodes to run (--episodes)")
    command = None if args.command is None else _command(args.command)
    changes = tuple(policy_overrides(args))
    return Wish(args.episodes, robots, args.as_trained, command, args.terrain, args.difficulty, changes)


def _command(text: str) -> tuple[float, float, float]:
    """Return vx, vy [m/s] and yaw rate [rad/s].

    Raises:
        ConfigError: the text is not three numbers.
    """
    try:
        vx, vy, yaw = (float(part) for part in text.split(","))
    except ValueError:
        vx = vy = yaw = float("nan")
    if not all(abs(value) <= 100.0 for value in (vx, vy, yaw)):
        raise ConfigError(f"--command: expected three numbers of at most 100 like 0.5,0,0.2, got '{text}'")
    return vx, vy, yaw


def check_listing(args: argparse.Namespace) -> None:
    """Check the options of `add_listing_arguments` before a task is built.

    Raises:
        ConfigError: an option is wrong.
    """
    for option, value in (("top", args.top), ("worst", args.worst)):
        if value < 0:
            raise ConfigError(f"--{option}: must be at least 0, got {value:,}")
    known = [FELL, *(column.name for column in COLUMNS)]
    if args.sort not in known:
        raise ConfigError(f"--sort: there is no order '{args.sort}'{suggest(args.sort, known)}")
    pages(args.page, None)
    if args.parquet:
        check_parquet("--parquet")


def pages(text: str | None, count: int | None) -> list[int]:
    """Return the numbers in --page; `count` is the number of episodes, None if it is not known yet.

    Raises:
        ConfigError: a part is not a number, or there is no such episode.
    """
    numbers = []
    for part in text.split(",") if text is not None else []:
        if not part.strip().isdecimal():
            raise ConfigError(f"--page: expected numbers of episodes like 3 or 3,17, got '{text}'")
        numbers.append(int(part))
        if count is not None and numbers[-1] >= count:
            raise ConfigError(f"--page: there is no episode {numbers[-1]}; they are 0 to {count - 1}")
    return numbers


def device_of(args: argparse.Namespace) -> torch.device:
    """Return the device to simulate on, and set torch up for it."""
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    return device


def engine_from(args: argparse.Namespace) -> str:
    """Return the argument that names the engine, for errors."""
    return "--physics" if args.physics else "sim.physics"


def folder_of(policy: TrainedPolicy) -> Path:
    """Return the default folder of a policy's episodes."""
    folder = policy.output("episodes")
    return folder / "episodes" if folder == policy.folder else folder


def show(episodes: Episodes, folder: Path, args: argparse.Namespace) -> None:
    """Print the list of episodes, and write it with the chosen pages and table into `folder`."""
    figures = figures_of(episodes)
    order = order_of(figures, args.sort, args.ended)
    wanted = pages(args.page, len(episodes)) + order[: args.worst]
    heads = heads_of(figures)
    texts = [i for i, head in enumerate(heads) if head in ("ended by", "joint")]
    rows = [row_of(figures, number) for number in order[: args.top]]
    print()
    title = f"{counts_text(figures)}; by {args.sort}"
    Console(width=130).print(screen_table(title, [head.replace(" [", "\n[") for head in heads], rows, texts))
    _write_list(folder, figures, order, args.sort)
    if args.parquet:
        write_parquet(episodes, folder)
    if wanted:
        projector = Projector(episodes, load_config(folder, "--page"))
        for number in dict.fromkeys(wanted):
            write_page(folder, episodes, figures, number, projector.show(number))


def _write_list(folder: Path, figures: Figures, order: list[int], by: str) -> None:
    """Write the whole list as Markdown."""
    text = markdown_table(heads_of(figures), [row_of(figures, number) for number in order], left=(1,)) + "\n"
    write_text(folder / LIST, f"# Episodes\n\n{counts_text(figures)}. The worst come first, by {by}.\n\n{text}")
    print(f"written: {relative(folder / LIST)}")


def label_of(episodes: Episodes) -> str:
    """Return the name of a policy in tables of its episodes."""
    run = str(episodes.about.get("run", episodes.about["task"])).split("/")
    return f"{run[-1]} (shipped)" if "policies" in run else "/".join([*run[-2:], episodes.about["checkpoint"]])


def print_statistics(folder: Path, found: dict[str, JointStatistics]) -> None:
    """Print the tables of joint statistics, then write their files."""
    console = Console(width=130)
    for title, table in tables_of(found).items():
        heads = [head.replace(", ", ",\n") for head in table.head]
        console.print(screen_table(title, heads, [[text_of(cell) for cell in row] for row in table.rows]))
    write_statistics(folder, found, "Joint statistics" if len(found) == 1 else "Joint statistics of two policies")
