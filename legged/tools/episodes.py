"""Episodes one by one, and what went wrong in them: `python -m legged.tools.episodes --task anymal_c_flat --worst 1`.

Lets robots run whole episodes under a policy, stores them (episodes.npz and .json) with every state, command, action, torque,
contact and reward part, and lists those that went worst. With --page or --worst, also a page an episode: a film beside plots,
with one cursor through all. With --statistics, mean and standard deviation of every joint; with --compare, of two policies.

For example:
  python -m legged.tools.episodes --task anymal_c --episodes 100 --sort torque --worst 3
  python -m legged.tools.episodes --stored logs/episodes/anymal_c --page 7,12
  python -m legged.tools.episodes --compare resources/policies/anymal_c_flat logs/anymal_c_flat/<run>
"""

import argparse
import sys
from pathlib import Path

import torch
from rich.console import Console

from legged.commandline.arguments import (
    add_run_arguments,
    add_task_arguments,
    pick_device,
    policy_overrides,
    register_given,
    settle_on,
)
from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser
from legged.episodes.film import Projector
from legged.episodes.joint_statistics import JointStatistics, check_comparable, joint_statistics
from legged.episodes.page import write_page
from legged.episodes.parquet import check_parquet, write_parquet
from legged.episodes.ranking import (
    COLUMNS,
    FELL,
    Figures,
    check_ended,
    counts_text,
    figures_of,
    heads_of,
    order_of,
    row_of,
)
from legged.episodes.rollout import MOST_EPISODES, Wish, check_wish, roll_out
from legged.episodes.statistics_report import tables_of, write_statistics
from legged.episodes.stored import (
    ABOUT,
    ARRAYS,
    NO_NUMBERS,
    TIME_UP,
    Episodes,
    load_config,
    load_episodes,
    save_episodes,
)
from legged.errors import ConfigError, suggest
from legged.evaluation.reports.document import text_of
from legged.evaluation.tables import markdown_table, screen_table
from legged.policies.restore import TrainedPolicy, find_policy, policy_of
from legged.process.paths import exists, ready_to_write, relative, write_text
from legged.registry import import_tasks

EPISODES, MOST_ROBOTS = 50, 256
"""Episodes, and robots that run them, if nobody says how many."""
TOP = 10
"""Episodes that are listed."""
LIST = "episodes.md"
STEP_BYTES = 1200
"""Room that a control step of a robot takes on the disk, at most, of the robots there are [bytes]."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_intermixed_args(argv)
    _check(args)
    if args.compare:
        return _compare(args)
    episodes, folder = _stored(args) if args.stored else _recorded(args)
    figures = figures_of(episodes)
    order = order_of(figures, args.sort, args.ended)
    wanted = _pages(args.page, len(episodes)) + order[: args.worst]
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
    if args.statistics:
        _print_statistics(folder, {_label(episodes): joint_statistics(episodes)})
    return 0


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "episodes",
        __doc__,
        "python -m legged.tools.episodes --task anymal_c_flat --worst 1",
        "python -m legged.tools.episodes --task anymal_c_flat --statistics --episodes 50",
    )
    add_task_arguments(parser, required=False)
    add_run_arguments(parser)
    parser.add_argument("--episodes", type=int, help=f"how many; {EPISODES}")
    parser.add_argument("--as_trained", action="store_true", help="with noise, pushes, randomisation and curricula")
    parser.add_argument("--command", nargs=3, type=float, metavar=("VX", "VY", "YAW"), help="held [m/s, m/s, rad/s]")
    parser.add_argument("--terrain", metavar="TYPE", help="type of a few tiles, e.g. stairs_up, in place of the training's")
    parser.add_argument("--difficulty", type=float, help="of such tiles, 0 to 1; 0.5 and 0.8 by default")
    parser.add_argument("--stored", type=Path, metavar="FOLDER", help="episodes recorded before; nothing is simulated")
    parser.add_argument(
        "--sort", default=FELL, help=f"{FELL}, {', '.join(column.name for column in COLUMNS)}; the worst first"
    )
    parser.add_argument("--ended", metavar="TERM", help="only episodes that this termination ended")
    parser.add_argument("--top", type=int, default=TOP, help=f"episodes to list; {TOP}")
    parser.add_argument("--page", metavar="IDS", help="episodes to make pages of, by number: 3 or 3,17")
    parser.add_argument("--worst", type=int, default=0, help="make pages of so many of the list")
    parser.add_argument("--statistics", action="store_true", help="mean and standard deviation of every joint")
    parser.add_argument("--parquet", action="store_true", help="also one flat table in Parquet; needs pyarrow")
    parser.add_argument("--compare", nargs=2, metavar=("A", "B"), help="two runs, shipped policies or folders of episodes")
    parser.add_argument("--out", type=Path, help="folder for all files; episodes/ in the run folder by default")
    return parser


def _check(args: argparse.Namespace) -> None:
    """Refuse what cannot be, before anything is built.

    Raises:
        ConfigError: there is something.
    """
    given = [flag for flag in ("task", "stored", "compare") if getattr(args, flag)]
    if len(given) != 1:
        what = f"got {' and '.join(f'--{flag}' for flag in given)}" if given else "none is given"
        raise ConfigError(f"--task: one of --task, --stored and --compare says whose episodes; {what}")
    if args.stored:
        for flag in ("episodes", "num_envs", "as_trained", "command", "terrain", "difficulty", "load_run", "checkpoint"):
            if getattr(args, flag) not in (None, False):
                raise ConfigError(f"--{flag}: nothing is simulated with --stored; leave one of them out")
    if args.compare:
        for flag in ("page", "worst", "ended", "load_run", "checkpoint", "statistics", "parquet"):
            if getattr(args, flag):
                raise ConfigError(f"--{flag}: --compare makes tables of joints only; leave one of them out")
    for flag, low, high in (
        ("episodes", 1, MOST_EPISODES),
        ("num_envs", 1, MOST_EPISODES),
        ("top", 0, None),
        ("worst", 0, None),
    ):
        value = getattr(args, flag)
        if value is not None and (value < low or (high is not None and value > high)):
            limit = f"at least {low}" if value < low else f"at most {high:,}"
            raise ConfigError(f"--{flag}: must be {limit}, got {value:,}")
    known = [FELL, *(column.name for column in COLUMNS)]
    if args.sort not in known:
        raise ConfigError(f"--sort: there is no order '{args.sort}'{suggest(args.sort, known)}")
    if args.command and not all(abs(value) <= 100.0 for value in args.command):
        raise ConfigError("--command: velocities must be numbers of at most 100")
    _pages(args.page, None)
    if args.parquet:
        check_parquet("--parquet")


def _pages(text: str | None, count: int | None) -> list[int]:
    """Return the numbers in --page; `count` is how many episodes there are, None where nobody knows yet.

    Raises:
        ConfigError: one is no number, or there is no such episode.
    """
    numbers = []
    for part in text.split(",") if text is not None else []:
        if not part.strip().isdecimal():
            raise ConfigError(f"--page: expected numbers of episodes like 3 or 3,17, got '{text}'")
        numbers.append(int(part))
        if count is not None and numbers[-1] >= count:
            raise ConfigError(f"--page: there is no episode {numbers[-1]}; they are 0 to {count - 1}")
    return numbers


def _wish(args: argparse.Namespace) -> Wish:
    episodes = args.episodes if args.episodes is not None else EPISODES
    return Wish(
        episodes=episodes,
        robots=args.num_envs if args.num_envs is not None else min(episodes, MOST_ROBOTS),
        as_trained=args.as_trained,
        command=tuple(args.command) if args.command else None,
        terrain=args.terrain,
        difficulty=args.difficulty,
        changes=tuple(policy_overrides(args)),
    )


def _stored(args: argparse.Namespace) -> tuple[Episodes, Path]:
    """Read the episodes of --stored; return them and the folder for what is made of them."""
    if args.module:
        import_tasks(args.module)
    episodes, folder = load_episodes(args.stored, "--stored"), args.out or args.stored
    ready_to_write(folder, 8.0)
    if folder != args.stored:
        save_episodes(episodes, load_config(args.stored, "--stored"), folder)
    return episodes, folder


def _recorded(args: argparse.Namespace) -> tuple[Episodes, Path]:
    """Record episodes of the policy that the command line names; return them and the folder where they were stored."""
    register_given(args)
    device = _device(args)
    policy = find_policy(args)
    wish = _wish(args)
    if wish.robots > wish.episodes:
        raise ConfigError(f"--num_envs: {wish.robots} robots have no more than {wish.episodes} episodes to run (--episodes)")
    _pages(args.page, wish.episodes)
    if args.ended is not None:  # before a recording takes the place of the one that there is
        terms = policy.cfg.terminations
        check_ended(args.ended, [*terms.failures, *terms.time_outs, TIME_UP, NO_NUMBERS])
    check_wish(policy, wish)
    folder = args.out or _folder(policy)
    steps = round(policy.cfg.env.episode_length_s / policy.cfg.dt)
    ready_to_write(folder, 8.0 + wish.episodes * steps * STEP_BYTES / 2**20)
    where = "--physics" if args.physics else "sim.physics"
    episodes, cfg = roll_out(policy, wish, device, not args.no_graph, where)
    save_episodes(episodes, cfg, folder)
    print(f"{policy.cfg.task}: {relative(policy.checkpoint)}, {len(episodes)} episodes in {episodes.about['physics']}")
    print(f"written: {relative(folder / ARRAYS)} and {ABOUT}")
    return episodes, folder


def _device(args: argparse.Namespace) -> torch.device:
    """Return the device to simulate on, and set torch up for it."""
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    return device


def _folder(policy: TrainedPolicy) -> Path:
    """Return where episodes of a policy go by default."""
    folder = policy.output("episodes")
    return folder / "episodes" if folder == policy.folder else folder


def _write_list(folder: Path, figures: Figures, order: list[int], by: str) -> None:
    """Write all of the list as Markdown."""
    text = markdown_table(heads_of(figures), [row_of(figures, number) for number in order], left=(1,)) + "\n"
    write_text(folder / LIST, f"# Episodes\n\n{counts_text(figures)}. The worst come first, by {by}.\n\n{text}")
    print(f"written: {relative(folder / LIST)}")


def _label(episodes: Episodes) -> str:
    """Return what tables call the policy of some episodes."""
    run = str(episodes.about.get("run", episodes.about["task"])).split("/")
    return f"{run[-1]} (shipped)" if "policies" in run else "/".join([*run[-2:], episodes.about["checkpoint"]])


def _compare(args: argparse.Namespace) -> int:
    """Compare the joints of two policies; return the exit code."""
    if args.module:
        import_tasks(args.module)
    device, wish = _device(args), _wish(args)
    folder = args.out or Path("logs") / "episodes" / "compare"
    ready_to_write(folder)
    sources: list[Episodes | TrainedPolicy] = [
        load_episodes(Path(name), "--compare") if exists(Path(name) / ABOUT) else policy_of(name, "--compare")
        for name in args.compare
    ]
    for source in sources:
        if isinstance(source, TrainedPolicy):
            check_wish(source, wish)
    found = {}
    for source in sources:
        where = "--physics" if args.physics else "sim.physics"
        episodes = source if isinstance(source, Episodes) else roll_out(source, wish, device, not args.no_graph, where)[0]
        label = _label(episodes)
        found[label if label not in found else f"{label} (2)"] = joint_statistics(episodes, "--compare")
    check_comparable(*found.values())
    _print_statistics(folder, found)
    return 0


def _print_statistics(folder: Path, found: dict[str, JointStatistics]) -> None:
    """Print the tables of joint statistics, then write their files."""
    console = Console(width=130)
    for title, table in tables_of(found).items():
        heads = [head.replace(", ", ",\n") for head in table.head]
        console.print(screen_table(title, heads, [[text_of(cell) for cell in row] for row in table.rows]))
    write_statistics(folder, found, "Joint statistics" if len(found) == 1 else "Joint statistics of two policies")


if __name__ == "__main__":
    sys.exit(main())
