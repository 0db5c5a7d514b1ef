"""Values and classes found in configuration files, each with its place."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

MEMBER_OF = "__found_at__"
"""Attribute of a class that was read: its place."""


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
    """The value; None if it is unknown."""
    place: Place
    why_unknown: str = ""
    """Reason why the value is unknown; empty if it is known."""


def members(owner: type) -> Iterator[tuple[str, Any]]:
    """Yield name and `Found` or class of each member of a class, inherited ones first."""
    merged: dict[str, Any] = {}
    for part in reversed(owner.__mro__[:-1]):
        merged.update({name: value for name, value in vars(part).items() if isinstance(value, Found | type)})
    yield from merged.items()


def place_of(owner: type) -> Place:
    """Return the place of a class definition."""
    return getattr(owner, MEMBER_OF, Place("legged_gym", 0))
