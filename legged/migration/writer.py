"""YAML text of a mapped task, with comments on its settings and the lost settings at its end."""

import dataclasses
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from legged.config.schema import LeggedConfig
from legged.config.yaml_files import dump
from legged.migration.translation import DEFAULTS

WIDTH = 120
FIRST = ("robot", "env", "terrain", "commands", "init_state", "control")
ORDER = [*FIRST, *(field.name for field in dataclasses.fields(LeggedConfig) if field.name not in FIRST)]
"""Sections of a task, in the order of the file."""


def task_yaml(head: Sequence[str], settings: Mapping[str, Any], comments: Mapping[str, str], lost: Sequence[str]) -> str:
    """Return the file of a task: a head, its sections, and the lost settings as comments. Lines of the head are wrapped
    unless they begin with a space.
    """
    sections: dict[str, Any] = {}
    for path, value in settings.items():
        *outer, name = path.split(".")
        inner = sections
        for key in outer:
            inner = inner.setdefault(key, {})
        inner[name] = value
    lines = [f"# {line}".rstrip() for text in head for line in _wrapped(text)]
    for key in sorted(sections, key=ORDER.index):
        sections[key] = _in_order(sections[key], DEFAULTS.get(key))
        if isinstance(sections[key], dict):
            lines.append("")
        lines += _lines(key, sections[key], key, comments, 0)
    if lost:
        lines += ["", "# Settings of the configuration that are not in this task:"]
        for text in lost:
            lines += textwrap.wrap(text, WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    return "\n".join(lines) + "\n"


def _in_order(section: Any, schema: Any) -> Any:
    """Return a section with its settings in the schema's order; unknown ones come last."""
    if not isinstance(section, dict) or not isinstance(schema, dict):
        return section
    names = sorted(section, key=lambda name: [*schema, name].index(name))
    return {name: _in_order(section[name], schema.get(name)) for name in names}


def _wrapped(text: str) -> list[str]:
    return [text] if text.startswith(" ") else textwrap.wrap(text, WIDTH - 2)


def _lines(key: str, value: Any, path: str, comments: Mapping[str, str], indent: int) -> Iterator[str]:
    """Yield the lines of a setting or a section."""
    start = f"{' ' * indent}{_text(key)}:"
    comment = f"  # {comments[path]}" if path in comments else ""
    inside = any(other.startswith(f"{path}.") for other in comments)
    if not isinstance(value, dict) or not value:
        yield from _with_comment(f"{start} {_text(value)}", comment, indent)
        return
    flow = f"{start} {_text(value)}"
    small = len(flow) <= WIDTH and not any(isinstance(item, dict) for item in value.values())
    if small and not inside and indent:
        yield from _with_comment(flow, comment, indent)
        return
    yield from _with_comment(start, comment, indent)
    for name, item in value.items():
        yield from _lines(name, item, f"{path}.{name}", comments, indent + 2)


def _with_comment(line: str, comment: str, indent: int) -> Iterator[str]:
    """Yield a line with its comment behind it, or before it if both together are too long."""
    if len(line) + len(comment) > WIDTH and comment:
        yield f"{' ' * indent}{comment.strip()}"
        yield line
    else:
        yield line + comment


def _text(value: Any) -> str:
    """Return a value as YAML on one line."""
    return dump(value, default_flow_style=True, width=10**9, sort_keys=False).removesuffix("\n...\n").strip()


def robot_yaml(head: Sequence[str], entries: Mapping[str, Any]) -> str:
    """Return a robot.yaml with the lines of a head."""
    lines = [f"# {line}" for text in head for line in _wrapped(text)]
    for key, value in entries.items():
        lines += _lines(key, value, key, {}, 0)
    return "\n".join(lines) + "\n"
