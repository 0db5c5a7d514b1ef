"""YAML texts of a migrated task and of its robot. Comments explain the task's settings and list the lost ones."""

import dataclasses
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from legged.config.legged import LeggedConfig
from legged.config.loader import merge, nest
from legged.config.origins import Origins
from legged.config.yaml_files import dump

WIDTH = 120
FIRST = ("robot", "env", "terrain", "commands", "init_state", "control")
ORDER = list(dict.fromkeys((*FIRST, *(field.name for field in dataclasses.fields(LeggedConfig)))))
"""Sections of a task, in the order of the file."""


def task_yaml(head: Sequence[str], settings: Mapping[str, Any], comments: Mapping[str, str], lost: Iterable[str]) -> str:
    """Return the text of a task's file: a head, comments on settings, the settings, and the lost settings as comments."""
    sections: dict[str, Any] = {}
    for path in sorted(settings, key=lambda path: ORDER.index(path.partition(".")[0])):
        merge(sections, nest(path, settings[path]), "", Origins())
    notes = [f"{path}: {text}" for path, text in comments.items() if path in settings]
    text = _comments([*head, *notes]) + "\n".join(_text(key, value) for key, value in sections.items())
    lost = [f"- {entry}" for entry in lost]
    return text + ("\n" + _comments(["Settings of the configuration that are not in this task:", *lost]) if lost else "")


def robot_yaml(head: Sequence[str], entries: Mapping[str, Any]) -> str:
    """Return the text of a robot.yaml that begins with the lines of `head`."""
    return _comments(head) + "".join(_text(key, value) for key, value in entries.items())


def _text(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return dump({key: value}, default_flow_style=None, width=WIDTH, sort_keys=False)
    return f"{key}: {dump(value, default_flow_style=True, width=10**9)}".removesuffix("...\n")


def _comments(lines: Iterable[str]) -> str:
    """Return wrapped comments; lines that begin with a space stay as they are."""
    wrapped = (
        [f"# {line}"] if line.startswith(" ") else textwrap.wrap(line, WIDTH, initial_indent="# ", subsequent_indent="#   ")
        for line in lines
    )
    return "".join(f"{line}\n" for part in wrapped for line in part)
