"""Task and settings from the command line of a training, stored in the run folder as given.json.

A user-defined task is found only if the module or YAML file that defines it is known. So the commands in the report of a run
name this module or file. If the task can't be found, the report shows the settings of the command line.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged.config.checks import shown
from legged.errors import ConfigError
from legged.process.paths import relative, write_text
from legged.registry import YAML_ENDINGS

INVOCATION_FILE = "given.json"


@dataclass(frozen=True)
class Invocation:
    """Task and settings of a command line."""

    task: str
    """Name of the task, or its YAML file."""
    module: str | None = None
    """Value of the option `--import`."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Dotted path -> value. A resumed training also has the settings of earlier command lines."""

    @property
    def flags(self) -> list[str]:
        """Options that another command needs to find a user-defined task."""
        files = [file for file in (self.module, self.task) if file and (file == self.module or file.endswith(YAML_ENDINGS))]
        return ["--import", ",".join(files)] if files else []


def write_invocation(folder: Path, invocation: Invocation, before: Path | None = None) -> None:
    """Write the invocation into a run folder. `before` is the folder of the run that is resumed, if there is one.

    Raises:
        RunError: the file can't be written.
    """
    earlier: Mapping[str, Any] = {}
    if before is not None:
        with suppress(ConfigError):  # a damaged file is skipped; the report of that run names it
            earlier = (read_invocation(before) or invocation).changes
    said = {"task": invocation.task, "import": invocation.module, "changes": {**earlier, **invocation.changes}}
    write_text(folder / INVOCATION_FILE, json.dumps(said, indent=1, default=str) + "\n")


def read_invocation(folder: Path) -> Invocation | None:
    """Read the invocation from a run folder. Return None for runs of old versions, which lack it.

    Raises:
        ConfigError: the file is damaged.
    """
    path = folder / INVOCATION_FILE
    if not path.is_file():
        return None
    try:
        said: Any = json.loads(path.read_text(encoding="utf-8"))
        for name, kind in (("task", str), ("import", str | None), ("changes", dict)):
            if not isinstance(said[name], kind):
                raise TypeError(f"{name}: got {shown(said[name])}")
        return Invocation(said["task"], said["import"], said["changes"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(f"{relative(path)}: not the task and settings of a training ({error})") from error
