"""What a training was told on its command line: given.json in its run folder.

A task of a user's own is known by its name to nobody who has not been told where it is. A report therefore names it as it was
named, and where it can't be looked up says what the command line set.
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
    """A task as it was named, and what was set."""

    task: str
    """Its name, or its YAML file."""
    module: str | None = None
    """What --import named."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Dotted path -> value; of a resumed training also those of the command lines before."""

    @property
    def flags(self) -> list[str]:
        """Options by which another command finds a user-defined task."""
        files = [file for file in (self.module, self.task) if file and (file == self.module or file.endswith(YAML_ENDINGS))]
        return ["--import", ",".join(files)] if files else []


def write_invocation(folder: Path, invocation: Invocation, before: Path | None = None) -> None:
    """Write what a training was told into its run folder; `before` is the folder that it goes on from, if it does.

    Raises:
        RunError: it can't be written.
    """
    earlier: Mapping[str, Any] = {}
    if before is not None:
        with suppress(ConfigError):  # a report on that run names what is damaged
            earlier = (read_invocation(before) or invocation).changes
    said = {"task": invocation.task, "import": invocation.module, "changes": {**earlier, **invocation.changes}}
    write_text(folder / INVOCATION_FILE, json.dumps(said, indent=1, default=str) + "\n")


def read_invocation(folder: Path) -> Invocation | None:
    """Read what the training of a run folder was told; None where it does not say that, as older ones do not.

    Raises:
        ConfigError: the file is none that was written here.
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
        raise ConfigError(f"{relative(path)}: does not say what a training was told ({error})") from error
