"""`legged episodes`: recordings of single episodes, pages about episodes, and statistics of joint states."""

import argparse
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from legged.commandline.arguments import (
    BUILD,
    IMPORT,
    POLICY,
    POLICY_HELP,
    import_given,
    measuring_device,
    policy_overrides,
    register_given,
    velocity_command,
)
from legged.commandline.command import sub_command
from legged.config import TaskConfig
from legged.deploy.command_parser import Argument, argument, check_number
from legged.episodes.joint_statistics import joint_statistics, tables_of, write_statistics
from legged.episodes.page import Projector, write_page
from legged.episodes.ranking import COLUMNS, FELL, check_ended, counts_text, figures_of, listing, order_of
from legged.episodes.recorder import MOST_EPISODES, Wish, check_wish, roll_out
from legged.episodes.stored import (
    ABOUT,
    ARRAYS,
    NO_NUMBERS,
    TIME_UP,
    Episodes,
    load_config,
    load_episodes,
    save_episodes,
    write_parquet,
)
from legged.errors import ConfigError, suggest
from legged.evaluation.reports.document import text_of
from legged.policies.restore import TrainedPolicy, policy_of
from legged.process.paths import exists, ready_to_write, relative, write_text
from legged.tables import markdown_table, screen_table

EPISODES, MOST_ROBOTS = 50, 256
"""Default number of episodes, and largest default number of robots."""
TOP = 10
"""Default number of listed episodes."""
LIST = "episodes.md"
STEP_BYTES = 1200
"""Largest disk space for a control step of a robot [bytes]."""
RECORDING = (
    argument("--episodes", type=int, default=EPISODES, help=f"number of episodes; {EPISODES} by default"),
    argument("--as-trained", action="store_true", help="keep the training's noise, pushes, randomisation and curricula"),
    argument("--command", metavar="VX,VY,YAW", help="velocity command of all episodes [m/s, m/s, rad/s]; default: random"),
    argument("--terrain", metavar="TYPE", help="type of the ground's tiles, e.g. stairs_up; default: ground of the training"),
    argument("--difficulty", type=float, help="difficulty of tiles, 0 to 1; default: 0.5 in the first row, 0.8 in the next"),
)
"""Options of the recording."""
LISTING = (
    argument("--sort", default=FELL, help=f"sort the list by one of these, worst first: {', '.join((FELL, *COLUMNS))}"),
    argument("--ended", metavar="TERM", help="list only episodes that this termination term ended"),
    argument("--top", type=int, default=TOP, help=f"number of episodes to list; {TOP} by default"),
    argument("--page", metavar="IDS", help="write pages about the episodes with these numbers, e.g. 3 or 3,17"),
    argument("--worst", type=int, default=0, help="write pages about the first WORST episodes of the list"),
    argument("--parquet", action="store_true", help="also write all control steps as a Parquet table; needs pyarrow"),
)
"""Options of a list of episodes, and of pages about episodes."""


def _wish_of(args: argparse.Namespace) -> Wish:
    """Return the settings of a recording from the options of the command line.

    Raises:
        ConfigError: a number is out of bounds, or the velocity command is malformed.
    """
    check_number("--episodes", args.episodes, 1, MOST_EPISODES)
    check_number("--num-envs", args.num_envs, 1, MOST_EPISODES)
    robots = args.num_envs if args.num_envs is not None else min(args.episodes, MOST_ROBOTS)
    if robots > args.episodes:
        raise ConfigError(f"--num-envs: {robots} robots are too many for {args.episodes} episodes (--episodes)")
    command = velocity_command(args.command) if args.command is not None else None
    changes = tuple(policy_overrides(args))
    return Wish(args.episodes, robots, args.as_trained, command, args.terrain, args.difficulty, changes)


def _check_listing(args: argparse.Namespace) -> None:
    """Check the options of `LISTING` before a task is built.

    Raises:
        ConfigError: an option is wrong.
    """
    check_number("--top", args.top, 0)
    check_number("--worst", args.worst, 0)
    if args.sort not in (FELL, *COLUMNS):
        raise ConfigError(f"--sort: cannot sort by '{args.sort}'{suggest(args.sort, (FELL, *COLUMNS))}")
    _pages(args.page, None)
    if args.parquet and find_spec("pyarrow") is None:
        raise ConfigError("--parquet: needs pyarrow, which is not installed; run `pip install 'legged[parquet]'`")


def _pages(text: str | None, count: int | None) -> list[int]:
    """Return the episode numbers in the value `text` of --page. `count` is the number of episodes; None if it is unknown.

    Raises:
        ConfigError: a part is not a number, or there is no such episode.
    """
    numbers = []
    for part in text.split(",") if text is not None else []:
        if not part.strip().isdecimal():
            raise ConfigError(f"--page: expected numbers of episodes like 3 or 3,17, got '{text}'")
        numbers.append(int(part))
        if count is not None and numbers[-1] >= count:
            raise ConfigError(f"--page: there is no episode {numbers[-1]}; episodes are numbered 0 to {count - 1}")
    return numbers


def _run_episodes(policy: TrainedPolicy, wish: Wish, args: argparse.Namespace) -> tuple[Episodes, TaskConfig]:
    """Run a policy's episodes on the device that the options choose; return the episodes and the task's configuration."""
    return roll_out(policy, wish, measuring_device(args), not args.no_graph, "--physics" if args.physics else "sim.physics")


def _show(episodes: Episodes, folder: Path, args: argparse.Namespace) -> None:
    """Print the top of the list of episodes; write the list, the chosen pages and the Parquet table into `folder`."""
    figures = figures_of(episodes)
    order = order_of(figures, args.sort, args.ended)
    wanted = _pages(args.page, len(episodes)) + order[: args.worst]
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


@sub_command(
    "legged episodes record anymal_c_flat --worst 1",
    "legged episodes record anymal_c --episodes 100 --sort torque --worst 3",
    arguments=(
        *POLICY,
        *RECORDING,
        *LISTING,
        argument("--out", type=Path, help="folder for all files; episodes/ in the run folder by default"),
    ),
)
def record(args: argparse.Namespace) -> int:
    """Record episodes and list the worst: `legged episodes record anymal_c_flat --worst 1`.

    A policy controls the robots for whole episodes. The files episodes.npz and episodes.json hold every state, command,
    action, torque, contact and reward term. The command lists the worst episodes. With --page or --worst, it also writes
    pages about single episodes. A page has a film and plots, with a common time cursor.
    """
    _check_listing(args)
    register_given(args, "policy")
    wish, policy = _wish_of(args), policy_of(args.policy, args.checkpoint)
    _pages(args.page, wish.episodes)
    if args.ended is not None:  # check --ended before a new recording replaces an older one
        terms = policy.cfg.terminations
        check_ended(args.ended, [*terms.failures, *terms.time_outs, TIME_UP, NO_NUMBERS])
    check_wish(policy, wish)
    folder = args.out or policy.output("episodes")
    if folder == policy.folder and args.out is None:
        folder /= "episodes"
    steps = round(policy.cfg.env.episode_length_s / policy.cfg.dt)
    ready_to_write(folder, 8.0 + wish.episodes * steps * STEP_BYTES / 2**20)
    episodes, cfg = _run_episodes(policy, wish, args)
    save_episodes(episodes, cfg, folder)
    print(f"{policy.cfg.task}: {relative(policy.checkpoint)}, {len(episodes)} episodes in {episodes.about['physics']}")
    print(f"written: {relative(folder / ARRAYS)} and {ABOUT}")
    _show(episodes, folder, args)
    return 0


@sub_command(
    "legged episodes list logs/episodes/anymal_c --page 7,12",
    "legged episodes list logs/episodes/anymal_c --sort torque --top 20",
    arguments=(
        argument("folder", type=Path, metavar="FOLDER", help="folder of recorded episodes"),
        IMPORT,
        *LISTING,
        argument("--out", type=Path, help="folder for all files; by default the folder of the episodes"),
    ),
)
def list_(args: argparse.Namespace) -> int:
    """List recorded episodes and write pages about them: `legged episodes list logs/episodes/anymal_c --page 7,12`.

    Nothing is simulated, because `legged episodes record` has stored all states in the folder.
    """
    _check_listing(args)
    import_given(args)
    episodes, folder = load_episodes(args.folder, "FOLDER"), args.out or args.folder
    ready_to_write(folder, 8.0)
    if folder != args.folder:
        save_episodes(episodes, load_config(args.folder, "FOLDER"), folder)
    _show(episodes, folder, args)
    return 0


def _sources(folder: str, *names: str) -> tuple[Argument, ...]:
    """Return positional arguments `names` for policies or recordings, followed by the options of a recording and --out."""
    helps = (f"{POLICY_HELP}, or a folder of recorded episodes", "policy or recording that is compared with the first one")
    return (
        *(argument(name, metavar="POLICY", help=says) for name, says in zip(names, helps, strict=False)),
        *BUILD,
        *RECORDING,
        argument("--out", type=Path, default=Path(folder), help=f"folder for all files; {folder} by default"),
    )


@sub_command(
    "legged episodes statistics anymal_c_flat --episodes 50",
    "legged episodes statistics logs/episodes/anymal_c",
    arguments=_sources("logs/episodes/statistics", "policy"),
)
def statistics(args: argparse.Namespace) -> int:
    """Measure mean and standard deviation of joint states: `legged episodes statistics anymal_c_flat --episodes 50`.

    The statistics cover every joint's angle, velocity and torque, in new episodes of a policy or in recorded episodes.
    """
    return _report(args, args.policy)


@sub_command(
    "legged episodes compare anymal_c_flat anymal_c_flat/2026-11-22_05-38-19",
    "legged episodes compare logs/episodes/anymal_c logs/episodes/anymal_c_blind --out comparison",
    arguments=_sources("logs/episodes/compare", "policy", "other"),
)
def compare(args: argparse.Namespace) -> int:
    """Show joint statistics of two policies side by side: `legged episodes compare anymal_c_flat logs/anymal_c_flat/RUN`.

    Each argument is a policy or a folder of recorded episodes. If it is a policy, the command runs new episodes.
    """
    return _report(args, args.policy, args.other)


def _report(args: argparse.Namespace, *names: str) -> int:
    """Print the joint statistics of policies or recordings, write them into the folder --out, and return 0.

    Raises:
        ConfigError: there is no such policy, an option does not fit the policy's task, or two policies have different joints.
    """
    import_given(args)
    wish = _wish_of(args)
    ready_to_write(args.out)
    sources = []
    for name in names:  # check all names before a task is built
        recorded = exists(Path(name) / ABOUT)
        sources.append(load_episodes(Path(name), "POLICY") if recorded else policy_of(name))
        if not isinstance(sources[-1], Episodes):
            check_wish(sources[-1], wish)
    found = {}
    for source in sources:
        episodes = source if isinstance(source, Episodes) else _run_episodes(source, wish, args)[0]
        run = str(episodes.about.get("run", episodes.about["task"])).split("/")
        label = f"{run[-1]} (shipped)" if "policies" in run else "/".join([*run[-2:], episodes.about["checkpoint"]])
        found[label if label not in found else f"{label} (2)"] = joint_statistics(episodes)
    console = Console(width=130)
    for title, table in tables_of(found).items():
        heads = [head.replace(", ", ",\n") for head in table.head]
        console.print(screen_table(title, heads, [[text_of(cell) for cell in row] for row in table.rows]))
    write_statistics(args.out, found)
    return 0
