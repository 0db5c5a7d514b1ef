"""Arguments and work that the sub-commands of `legged episodes` share."""

import argparse
from importlib.util import find_spec
from pathlib import Path

import torch
from rich.console import Console

from legged.commandline.arguments import add_build_arguments, pick_device, policy_overrides, settle_on
from legged.config import TaskConfig
from legged.episodes.page import Projector, write_page
from legged.episodes.ranking import COLUMNS, FELL, counts_text, figures_of, listing, order_of
from legged.episodes.recorder import MOST_EPISODES, Wish, roll_out
from legged.episodes.stored import Episodes, load_config, write_parquet
from legged.errors import ConfigError, suggest
from legged.policies.restore import TrainedPolicy
from legged.process.paths import relative, write_text
from legged.tables import markdown_table, screen_table

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
    parser.add_argument("--sort", default=FELL, help=f"{', '.join((FELL, *COLUMNS))}; the worst first")
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
    command = None
    if args.command is not None:
        try:
            vx, vy, yaw = (float(part) for part in args.command.split(","))
        except ValueError:
            vx = vy = yaw = float("nan")
        if not all(abs(value) <= 100.0 for value in (vx, vy, yaw)):
            raise ConfigError(f"--command: expected three numbers of at most 100 like 0.5,0,0.2, got '{args.command}'")
        command = vx, vy, yaw
    changes = tuple(policy_overrides(args))
    return Wish(args.episodes, robots, args.as_trained, command, args.terrain, args.difficulty, changes)


def check_listing(args: argparse.Namespace) -> None:
    """Check the options of `add_listing_arguments` before a task is built.

    Raises:
        ConfigError: an option is wrong.
    """
    for option, value in (("top", args.top), ("worst", args.worst)):
        if value < 0:
            raise ConfigError(f"--{option}: must be at least 0, got {value:,}")
    if args.sort not in (FELL, *COLUMNS):
        raise ConfigError(f"--sort: there is no order '{args.sort}'{suggest(args.sort, (FELL, *COLUMNS))}")
    pages(args.page, None)
    if args.parquet and find_spec("pyarrow") is None:
        raise ConfigError("--parquet: needs pyarrow, which is not installed: pip install 'legged[parquet]'")


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


def run_episodes(policy: TrainedPolicy, wish: Wish, args: argparse.Namespace) -> tuple[Episodes, TaskConfig]:
    """Run a policy's episodes on the device of the command line; return them and their task's configuration."""
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    return roll_out(policy, wish, device, not args.no_graph, "--physics" if args.physics else "sim.physics")


def show(episodes: Episodes, folder: Path, args: argparse.Namespace) -> None:
    """Print the list of episodes; write all of it as Markdown into `folder`, with the chosen pages and table."""
    figures = figures_of(episodes)
    order = order_of(figures, args.sort, args.ended)
    wanted = pages(args.page, len(episodes)) + order[: args.worst]
    (heads, rows), counts = listing(figures, order), counts_text(figures)
    texts = [i for i, head in enumerate(heads) if head in ("ended by", "joint")]
    shown = screen_table(f"{counts}; by {args.sort}", [head.replace(" [", "\n[") for head in heads], rows[: args.top], texts)
    print()
    Console(width=130).print(shown)
    table = markdown_table(heads, rows, left=(1,))
    write_text(folder / LIST, f"# Episodes\n\n{counts}. The worst come first, by {args.sort}.\n\n{table}\n")
    print(f"written: {relative(folder / LIST)}")
    if args.parquet:
        write_parquet(episodes, folder)
    if wanted:
        projector = Projector(episodes, load_config(folder, "--page"))
        for number in dict.fromkeys(wanted):
            write_page(folder, episodes, figures, number, projector.show(number))
