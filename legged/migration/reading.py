"""Reading of a fork's configuration. `child.py` runs the fork's files in another process; this module reads its output.

`legged_gym.yaml` has legged_gym's configuration classes (`known`), so that files that extend them run without legged_gym. It
also has rsl_rl's defaults, and digests of legged_gym's methods, by which changed formulas are recognised.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legged.config.checks import shown
from legged.config.yaml_files import read_yaml
from legged.errors import ConfigError, suggest
from legged.process.paths import relative

CHILD = Path(__file__).with_name("child.py")
LONGEST_S = 600
"""Largest time that the fork's files may take [s]."""
ORIGINAL = read_yaml(CHILD.with_name("legged_gym.yaml"))
DEFAULTS: dict[str, Any] = ORIGINAL["known"]["LeggedRobotCfg"][1] | ORIGINAL["known"]["LeggedRobotCfgPPO"][1]
"""Values of legged_gym's two base classes."""
DIGESTS: dict[str, str] = ORIGINAL["digests"]
"""Method of legged_gym -> digest of its text (`child.method`)."""


@dataclass(frozen=True)
class Found:
    """A value of the configuration."""

    value: Any
    """The value; None if it is unknown."""
    place: str
    """File and line."""
    why_unknown: str = ""
    """Reason why the value is unknown; empty if it is known."""


@dataclass(frozen=True)
class Method:
    """A method of the environment's class."""

    place: str
    original: bool
    """True if the method is the same as legged_gym's method of that name."""
    reads: dict[str, str]
    """Name in `child.READS` that the method reads -> text of the pattern's group."""


@dataclass(frozen=True)
class Fork:
    """Values and methods of a fork."""

    task: str
    """Name of the task."""
    described: str
    """Names of the configuration classes, as one text."""
    settings: dict[str, Found]
    """Settings of the environment and of the learner, by dotted path."""
    methods: dict[str, list[Method]]
    """Rewards and hooks by name. A name has several methods if the class of the task is not known. Empty if no class was
    found."""
    observations: list[Any]
    """Parts of the policy's and of the value function's observations (`child.observations`)."""
    terrains: list[Any] | None
    """Terrain functions of each entry of `terrain_proportions` (`child.terrains`)."""


def read_fork(path: Path, asked: str | None) -> Fork:
    """Run the file at `path` and return its values and methods. `asked` is a class of the file, a registered task, or the
    name of the new task.

    Raises:
        ConfigError: the file fails, has no configuration, or has several and `asked` is not one of them.
    """
    data = run_child(path, asked)
    if "error" in data:
        place = _place(*data["place"]) if data["place"][0] else relative(path)
        raise ConfigError(f"{place}: the file does not run: {data['error']}{data['said']}")
    if "settings" not in data:
        which = suggest(asked or "", [*data["classes"], *data["tasks"]], "--task")
        if data["classes"]:
            given = "" if asked is None else f", but none is called {shown(asked)}"
            raise ConfigError(f"--task: {relative(path)} has several configurations{given}; name one{which}")
        tasks = f"; choose a registered task: --task{suggest(asked or '', data['tasks'], 'tasks')}" if data["tasks"] else ""
        raise ConfigError(f"{relative(path)}: has no configuration of an environment (class XCfg(LeggedRobotCfg)){tasks}")
    settings = {path: Found(value, _place(*where), why) for path, (value, *where, why) in data["settings"].items()}
    for section, values in ORIGINAL["rsl_rl"].items():
        named = [found.place for name, found in settings.items() if name.startswith(f"{section}.")]
        if named:  # for values that the fork does not set, rsl_rl's defaults apply
            missing = {f"{section}.{name}": Found(value, f"rsl_rl's default; {named[0]}") for name, value in values.items()}
            settings = missing | settings
    built_in = f"; {', '.join(sorted(data['built_in']))} from legged_gym v1.0.2" if data["built_in"] else ""
    methods = {
        name: [Method(_place(*m["place"]), m["digest"] == DIGESTS.get(name), m["reads"]) for m in entries]
        for name, entries in data["methods"].items()
    }
    names = [*data["names"], "no learner's configuration"][:2]
    return Fork(data["task"], f"{' and '.join(names)}{built_in}", settings, methods, data["observations"], data["terrains"])


def _place(file: str, line: int) -> str:
    """Return `file:line`, or only `file` if `line` is 0."""
    return f"{relative(Path(file))}:{line}" if line else file


def run_child(path: Path, asked: str | None) -> dict[str, Any]:
    """Run `child.py` and return its answer. The entry `said` quotes the last line that the user's files printed."""
    request = {"file": str(path.resolve()), "task": asked, "known": ORIGINAL["known"], "methods": list(DIGESTS)}
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(
                [sys.executable, "-P", str(CHILD)],  # -P keeps the child's folder off the import path
                input=json.dumps(request).encode(),
                stdout=subprocess.PIPE,
                stderr=output,
                env=os.environ | {"PYTORCH_JIT": "0"},
                timeout=LONGEST_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ConfigError(f"{relative(path)}: the file did not end within {LONGEST_S} s") from None
        output.seek(0)
        lines = output.read().decode(errors="replace").strip().splitlines()
    said = f"; it printed: {lines[-1]}" if lines else ""
    try:
        return json.loads(done.stdout) | {"said": said}
    except ValueError:
        raise ConfigError(f"{relative(path)}: Python ended with code {done.returncode} while the file ran{said}") from None
