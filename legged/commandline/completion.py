"""A script that completes our commands in a shell: tasks, flags, dotted keys of the configuration, and their values.

The script is made once and holds what it needs, because to ask Python at every key would take the seconds that torch takes to
be imported. Only tasks are looked up while somebody types: they are files.
"""

import argparse
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from legged.config.reference import fields
from legged.envs import BaseTask, LeggedRobot
from legged.physics.fields import FIELDS
from legged.process.paths import data_folder
from legged.terrain import TERRAIN_TYPES

SHELLS = ("bash", "zsh")
TASKS = "@tasks"
"""Stands for the names of all tasks among the values of a flag."""


@dataclass(frozen=True)
class Words:
    """What can be typed after a command."""

    flags: tuple[str, ...]
    """Flags, with their dashes."""
    values: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Flag -> values that it takes, where they can be counted; `TASKS` stands for tasks."""
    tasks: bool = False
    """Whether names of tasks may stand alone."""
    keys: bool = False
    """Whether `key=value` may stand alone."""


def words_of(parser: argparse.ArgumentParser, choices: Mapping[str, tuple[str, ...]]) -> Words:
    """Return what can be typed after the command that a parser reads. Flags that set a field take the values in `choices`,
    those of the fields with some.
    """
    alone = {name for action in parser._actions if not action.option_strings for name in str(action.metavar).split(" | ")}
    of_flags = {"--physics": choices["sim.physics"], "--solver": choices["sim.solver"]}
    if "key=value" in alone or any("--load_run" in action.option_strings for action in parser._actions):
        of_flags["--task"] = (TASKS,)
    flags: list[str] = []
    values: dict[str, tuple[str, ...]] = {}
    for action in parser._actions:
        for name in action.option_strings:
            if name.startswith("--") and action.help != argparse.SUPPRESS:
                flags.append(name)
                known = tuple(map(str, action.choices)) if action.choices else of_flags.get(name, ())
                values |= {name: known} if known else {}
    return Words(tuple(flags), values, "TASK" in alone, "key=value" in alone)


def keys_of(kinds: Iterable[type[BaseTask]]) -> dict[str, tuple[str, ...]]:
    """Return dotted key -> values it may have, empty where they can't be counted, of all fields that tasks of these classes
    have; of maps by terms, terrain types and properties of the model also their entries.
    """
    found: dict[str, tuple[str, ...]] = {}
    for kind in kinds:
        entries: dict[str, Iterable[str]] = {
            "rewards.scales": kind.terms("_reward_"),
            "observations.scales": kind.terms("_obs_"),
            "observations.noise": kind.terms("_obs_"),
            "domain_rand.ranges": FIELDS,
        }
        if issubclass(kind, LeggedRobot):
            entries |= {"terrain.proportions": TERRAIN_TYPES, "terrain.sizes": TERRAIN_TYPES}
        for text in fields(kind.Config):
            if not text.is_section:
                found |= {text.path.replace("<name>", group): text.choices for group in ("actor", "critic")}
            found |= {f"{text.path}.{name}": () for name in entries.get(text.path, ())}
    return dict(sorted(found.items()))


def script(shell: str, commands: Mapping[str, Words], keys: Mapping[str, tuple[str, ...]]) -> str:
    """Return the script for a shell, bash or zsh, that completes `commands` (module -> words)."""
    lines = [f"# Completion of legged for {shell}, written by `python -m legged.tools.completion {shell}`."]
    lines += _function("_legged_modules", commands)
    lines += _function("_legged_keys", keys)
    lines += _cases("_legged_choices", {key: choices for key, choices in keys.items() if choices})
    lines += _cases("_legged_flags", {name: words.flags for name, words in commands.items()})
    pairs = {f"{name} {flag}": values for name, words in commands.items() for flag, values in words.values.items()}
    lines += _cases("_legged_values", pairs)
    lines += _cases("_legged_alone", {name: _alone(words) for name, words in commands.items() if _alone(words)})
    lines += [f"_legged_cfg={shlex.quote(str(data_folder('cfg')))}", ""]
    templates = Path(__file__).parent
    return "\n".join(lines) + "".join(
        (templates / name).read_text(encoding="utf-8") for name in ("completion_common.sh", f"completion.{shell}")
    )


def _alone(words: Words) -> list[str]:
    return [*([TASKS] if words.tasks else []), *(["@keys"] if words.keys else [])]


def _function(name: str, words: Iterable[str]) -> list[str]:
    """Return a function of the shell that prints words, one a line."""
    return [f"{name}() {{", "cat <<'END'", *words, "END", "}"]


def _cases(name: str, table: Mapping[str, Iterable[str]]) -> list[str]:
    """Return a function of the shell that prints the words which a table has for its argument."""
    cases = [f"  {shlex.quote(key)}) printf '%s\\n' {shlex.join(words)} ;;" for key, words in table.items()]
    return [f"{name}() {{", '  case "$1" in', *cases, "  esac", "}"]
