"""What was found in configuration files: values and classes, each with its place."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

MEMBER_OF = "__found_at__"
"""Attribute of a class that was read: where it stands."""


@dataclass(frozen=True)
class Place:
    """A line of a file."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


@dataclass(frozen=True)
class Found:
    """A value that a class or a module sets."""

    value: Any
    """What it is; None where it is not known."""
    place: Place
    why_unknown: str = ""
    """Why it is not known; empty where it is."""


def members(owner: type) -> Iterator[tuple[str, Any]]:
    """Yield what a class sets itself or inherits: name and `Found` or class, the bases' first."""
    merged: dict[str, Any] = {}
    for part in reversed(owner.__mro__[:-1]):
        merged.update({name: value for name, value in vars(part).items() if isinstance(value, Found | type)})
    yield from merged.items()


def place_of(owner: type) -> Place:
    """Return where a class stands."""
    return getattr(owner, MEMBER_OF, Place("legged_gym", 0))
