"""The `legged` command: finds the sub-command that was typed and runs it.

This module imports nothing large, so that `legged --help` answers without loading torch.
"""

import difflib
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module

from legged.commandline.command import SubCommand, run_main
from legged.errors import ConfigError, suggest

SECTIONS = {
    "every day": ("train", "play", "watch", "list"),
    "measure": ("evaluate", "runs", "episodes", "benchmark", "sweep"),
    "your own": ("robot", "terrain", "motion", "fit-actuator", "migrate"),
    "on a robot": ("export", "deploy"),
    "this machine": ("warmup", "completion"),
}
"""Heading in the help -> first words of the commands under it."""

COMMANDS: Mapping[str, tuple[str, str]] = {
    "train": ("legged.cli.train:train", "train a policy"),
    "play": ("legged.cli.play:play", "film a policy, measure it and export it"),
    "watch": ("legged.cli.watch:watch", "watch a policy in the browser, also while it is trained"),
    "evaluate": ("legged.cli.evaluate:evaluate", "measure a policy; its task decides what is measured"),
    "evaluate grid": ("legged.cli.evaluate:grid", "velocity errors over a grid of commands"),
    "evaluate terrain": ("legged.cli.evaluate:terrain", "success against the size of stairs, gaps, slopes, ..."),
    "evaluate stress": ("legged.cli.evaluate:stress", "success under disturbances and on unknown ground"),
    "evaluate checkpoints": ("legged.cli.evaluate:checkpoints", "search a run for its first checkpoint that walks"),
    "evaluate episodes": ("legged.cli.evaluate:episodes", "returns and lengths of episodes, for tasks without commands"),
    "evaluate motions": ("legged.cli.evaluate:motions", "success and errors of a policy that tracks motions"),
    "evaluate gymnasium": ("legged.cli.evaluate:gymnasium", "returns in Gymnasium's own environment"),
    "evaluate league": ("legged.cli.evaluate.league:league", "a policy of a G1 or an H1 in the public walking league"),
    "evaluate onnx": ("legged.cli.evaluate:onnx", "ONNX policies, foreign ones too, in plain MuJoCo"),
    "runs": ("legged.cli.runs:runs", "all runs in one table (the same as `runs table`)"),
    "runs table": ("legged.cli.runs:runs", "all runs in one table"),
    "runs report": ("legged.cli.runs:report", "a page about one run: settings, curves, evaluations, film"),
    "runs compare": ("legged.cli.runs:compare", "settings, curves and evaluations of several runs side by side"),
    "runs evaluations": ("legged.cli.runs:evaluations", "evaluation files side by side, seeds averaged"),
    "runs curves": ("legged.cli.runs:curves", "learning curves of runs as a picture"),
    "episodes record": ("legged.cli.episodes:record", "record episodes and list the worst"),
    "episodes list": ("legged.cli.episodes:list_", "list recorded episodes, make pages of them"),
    "episodes statistics": ("legged.cli.episodes:statistics", "mean and standard deviation of every joint"),
    "episodes compare": ("legged.cli.episodes:compare", "joint statistics of two policies side by side"),
    "sweep run": ("legged.cli.sweep:run", "search settings by many trainings"),
    "sweep report": ("legged.cli.sweep:report", "table and figures of a sweep"),
    "benchmark step": ("legged.cli.benchmark:step", "times of a control step and of training iterations"),
    "benchmark scale": ("legged.cli.benchmark:scale", "speed against the number of robots"),
    "benchmark ground": ("legged.cli.benchmark:ground", "speed on a plane, and on terrain with two colliders"),
    "benchmark startup": ("legged.cli.benchmark:startup", "how long a training takes to begin"),
    "robot add": ("legged.cli.robot:add", "turn a URDF or MJCF file into a robot and a task"),
    "robot show": ("legged.cli.robot:show", "joints, limits, gains and feet of a robot"),
    "terrain": ("legged.cli.terrain:terrain", "pictures of a task's terrain"),
    "motion": ("legged.cli.motion:motion", "check and resample reference motions, and film them"),
    "export": ("legged.cli.export:export", "export every checkpoint of a run to ONNX"),
    "deploy sim": ("legged.cli.deploy:sim", "run the robot's program against a simulated robot"),
    "deploy robot": ("legged.cli.deploy:robot", "serve a simulated robot over UDP"),
    "fit-actuator": ("legged.cli.fit_actuator:fit_actuator", "fit a motor model to a log of a real motor"),
    "migrate": ("legged.cli.migrate:migrate", "translate a legged_gym configuration"),
    "warmup": ("legged.cli.warmup:warmup", "compile and cache the kernels of a task"),
    "completion": ("legged.cli.completion:completion", "print a completion script for a shell"),
    "list": ("legged.cli.list:list_", "list tasks and robots"),
}
"""Words of a command -> `module:function`, and a summary."""


def main(argv: list[str] | None = None) -> int:
    """Run the command that `argv` begins with; return its exit code. If `argv` is None, use the arguments of this process."""
    words = sys.argv[1:] if argv is None else argv
    name, rest = split(words)
    if name is None:
        return run_main(lambda _: _print_help(words), argv)
    found = load(name)
    if argv is not None:
        return found.main(rest)
    sys.argv = [sys.argv[0], *rest]
    return found.main()


def load(name: str) -> SubCommand:
    """Import and return a command."""
    module, _, inside = COMMANDS[name][0].partition(":")
    return getattr(import_module(module), inside)  # type: ignore[no-any-return]


def split(words: list[str]) -> tuple[str | None, list[str]]:
    """Return the name of the command at the beginning of `words` (None without a known command), and the words after it."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if len(words) >= count and name in COMMANDS:
            return name, words[count:]
    return None, words


@contextmanager
def hint_at_sub_command(group: str, words: Sequence[str]) -> Iterator[None]:
    """Add a hint to an error whose text contains one of `words`, if a sub-command of `group` is spelt almost like this word.

    Raises:
        ConfigError: the `with` block raised it; a hint may have been added.
    """
    try:
        yield
    except ConfigError as error:
        for word in words:
            near = difflib.get_close_matches(word, sub_commands(group), n=1)
            if near and word in str(error):
                raise ConfigError(f"{error}; did you mean the sub-command `legged {group} {near[0]}`?") from error
        raise


def sub_commands(group: str) -> list[str]:
    """Return the second words of a group's commands."""
    return [name.partition(" ")[2] for name in COMMANDS if name.startswith(f"{group} ")]


def print_rows(title: str, rows: Mapping[str, str], width: int = 0) -> None:
    """Print a title, and a row with name and text for each of `rows`. The column of names has at least `width` characters."""
    width = max([width, *map(len, rows)])
    print(f"{title}:")
    for name, summary in rows.items():
        print(f"  {name:{width}}  {summary}".rstrip())


def _print_help(words: list[str]) -> int:
    """Print all commands, or the commands of a group `words`. Return the exit code 0. Raise ConfigError for unknown words."""
    groups: dict[str, dict[str, str]] = {}
    for name, (_, summary) in COMMANDS.items():
        groups.setdefault(name.partition(" ")[0], {})[name] = summary
    asked = [word for word in words if word not in ("--help", "-h")]
    if not asked:
        print("Train legged robots, see them walk, measure them.\n\nusage: legged COMMAND ...  (each command has --help)\n")
        for heading, firsts in SECTIONS.items():
            rows = {name: said for first in firsts for name, said in groups[first].items()}
            print_rows(heading, rows, max(map(len, COMMANDS)))
            print()
        print("begin with `legged play anymal_c` (a trained policy), `legged train anymal_c_flat`, `legged list`")
        return 0
    if asked[0] not in groups:
        raise ConfigError(f"legged: there is no command '{asked[0]}'{suggest(asked[0], groups, 'commands')}")
    if len(asked) > 1:
        near = suggest(asked[1], sub_commands(asked[0]), "sub-commands")
        raise ConfigError(f"legged {asked[0]}: there is no sub-command '{asked[1]}'{near}")
    print_rows(f"commands of `legged {asked[0]}`, each with --help", groups[asked[0]])
    return 0
