"""Reading of a fork's configuration: `child.py` runs it in another process, and this module takes what it prints."""

import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legged.config.checks import shown
from legged.errors import ConfigError, suggest
from legged.migration.legged_gym_defaults import DIGESTS, KNOWN, LEFT_OUT
from legged.process.paths import relative

CHILD = Path(__file__).with_name("child.py")
LONGEST_S = 600
"""Largest time that the fork's files may take [s]."""
SAID = 2000
"""Largest length of the output of the fork's files that is looked at, in bytes."""


@dataclass(frozen=True)
class Place:
    """A line of a file."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{relative(Path(self.file))}:{self.line}" if self.line else self.file


@dataclass(frozen=True)
class Found:
    """A value of the configuration."""

    value: Any
    """The value; None if it is unknown."""
    place: Place
    why_unknown: str = ""
    """Reason why the value is unknown; empty if it is known."""


@dataclass(frozen=True)
class Method:
    """A method of the environment's class."""

    place: Place
    original: bool
    """True if it is legged_gym's method of that name."""
    reads: tuple[str, ...]
    """Names of `child.READS` that it reads."""


@dataclass(frozen=True)
class Fork:
    """The live objects of a fork."""

    task: str
    """Name of the task."""
    described: str
    """Names of the classes."""
    settings: dict[str, Found]
    """Settings of the environment and of the learner, by dotted path."""
    methods: dict[str, list[Method]]
    """Rewards and hooks by name; several if the class of the task is not known. Empty if no class was found."""
    observations: list[Any]
    """Parts of the policy's and of the value function's observations (`child.observations`)."""
    terrains: list[Any] | None
    """Terrain functions of each entry of `terrain_proportions` (`child.terrains`)."""


def read_fork(path: Path, asked: str | None) -> Fork:
    """Run the file at `path` and return its live objects. `asked` is a class of the file, a registered task, or the name of
    the new task.

    Raises:
        ConfigError: the file fails, or has no configuration, or several and `asked` chooses none of them.
    """
    data = _run({"file": str(path.resolve()), "task": asked, "known": KNOWN, "methods": list(DIGESTS)}, path)
    if "error" in data:
        place = Place(*data["place"]) if data["place"][0] else relative(path)
        raise ConfigError(f"{place}: the file does not run: {data['error']}{data['said']}")
    if "settings" not in data:
        raise _no_choice(path, asked, data["classes"], data["tasks"])
    learning = {name: _found(entry) for name, entry in data["learning"].items()}
    for section, values in LEFT_OUT.items():
        named = [found.place for name, found in learning.items() if name.startswith(f"{section}.")]
        if named:  # a section without base class leaves missing settings to rsl_rl
            place = Place(f"rsl_rl's default; {named[0]}", 0)
            learning = {f"{section}.{name}": Found(value, place) for name, value in values.items()} | learning
    parts = [data["environment"], data["learner"] or "no learner's configuration"]
    built_in = f"; {', '.join(sorted(data['built_in']))} as legged_gym v1.0.2 has them" if data["built_in"] else ""
    methods = {
        name: [Method(Place(*m["place"]), m["digest"] == DIGESTS.get(name), tuple(m["reads"])) for m in entries]
        for name, entries in data["methods"].items()
    }
    return Fork(
        task=data.get("given") or (_snake(data["task"]) if data["task"] in data["classes"] else data["task"]),
        described=f"{' and '.join(parts)}{built_in}",
        settings={name: _found(entry) for name, entry in data["settings"].items()} | learning,
        methods=methods,
        observations=data["observations"],
        terrains=data["terrains"],
    )


def _snake(name: str) -> str:
    """Return a task name for a class: 'GO2RoughCfg' -> 'go2_rough'."""
    name = re.sub(r"(Cfg|Config)$", "", name) or name
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return name.lower().strip("_") or "task"


def _found(entry: list[Any]) -> Found:
    value, file, line, why = entry
    return Found(value, Place(file, line), why)


def _run(request: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the child's answer, with the last line of the output of the user's files as `said`."""
    command = [sys.executable, "-P", str(CHILD)]  # without the child's folder among the modules
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(
                command,
                input=json.dumps(request).encode(),
                stdout=subprocess.PIPE,
                stderr=output,
                env=os.environ | {"PYTORCH_JIT": "0"},
                timeout=LONGEST_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ConfigError(f"{relative(path)}: the file did not end within {LONGEST_S} s") from None
        output.seek(max(0, output.seek(0, os.SEEK_END) - SAID))
        lines = output.read().decode(errors="replace").strip().splitlines()
    said = f"; it printed: {lines[-1]}" if lines else ""
    try:
        return json.loads(done.stdout) | {"said": said}
    except ValueError:
        raise ConfigError(f"{relative(path)}: Python ended with code {done.returncode} while the file ran{said}") from None


def _no_choice(path: Path, asked: str | None, classes: list[str], tasks: list[str]) -> ConfigError:
    """Return the error of a file with no configuration, or with several."""
    if not classes:
        of_tasks = f"; it registers tasks: --task{suggest(asked or '', tasks, 'tasks')}" if tasks else ""
        return ConfigError(f"{relative(path)}: has no configuration of an environment (class XCfg(LeggedRobotCfg)){of_tasks}")
    given = "" if asked is None else f"{shown(asked)} is none of them: "
    which = suggest(asked or "", [*classes, *tasks], "--task")
    return ConfigError(f"--task: {relative(path)} has several configurations, {given}say which{which}")
