"""A task made from a fork's configuration: settings, comments on them, and lost settings."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from legged.config.checks import build, shown
from legged.config.dotted import value_at
from legged.config.loader import nest, to_dict
from legged.config.origins import Origins
from legged.config.schema import LeggedConfig
from legged.errors import ConfigError
from legged.migration.legged_gym_defaults import DEFAULTS as OF_LEGGED_GYM
from legged.migration.reading import Found, Place

DEFAULTS = to_dict(LeggedConfig())
LARGEST_NUMBER = 1e12
"""Largest number that a setting can plausibly have."""
PI = 3.14
"""legged_gym's value for half a turn."""


@dataclass(frozen=True)
class Lost:
    """A setting that has no counterpart here, or another meaning."""

    place: Place
    setting: str
    value: str
    reason: str
    """Empty if no setting here is near."""

    def __str__(self) -> str:
        value = f" = {self.value}" if self.value else ""
        return f"{self.place}: {self.setting}{value}: {self.reason or 'no setting here has that meaning'}"


@dataclass
class Translation:
    """The task that a configuration becomes."""

    theirs: dict[str, Found]
    """Settings of the environment and of the learner, by dotted path."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Dotted path here -> value, where it differs from the default."""
    comments: dict[str, str] = field(default_factory=dict)
    """Dotted path here -> comment."""
    lost: list[Lost] = field(default_factory=list)
    minor: list[str] = field(default_factory=list)
    """Paths of lost settings that change no task."""
    done: set[str] = field(default_factory=set)
    """Dotted paths of the file's settings that were handled."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """Subject (rewards, observations, robot, ...) -> lines about it. They come first in the report."""

    def get(self, path: str, default: Any = None) -> Any:
        """Return a value of the file; `default` if it is not set or unknown. For settings that are computed from several
        values.
        """
        self.done.add(path)
        found = self.theirs.get(path)
        if found is not None and found.why_unknown:
            self.lose(path, found.why_unknown)
        return default if found is None or found.why_unknown else found.value

    def number(self, path: str, default: float) -> float:
        """Return a value of the file that must be a number."""
        return self._of_kind(path, default, is_number, "a number")

    def numbers(self, path: str, default: list[float]) -> list[float]:
        """Return a value of the file that must be a list of numbers."""
        return list(
            self._of_kind(path, default, lambda x: isinstance(x, list) and all(map(is_number, x)), "a list of numbers")
        )

    def table(self, path: str) -> dict[str, float]:
        """Return a value of the file that must be a table of names and numbers."""
        found = self._of_kind(path, {}, _is_table, "names and their numbers")
        return {name: float(value) for name, value in found.items()}

    def _of_kind(self, path: str, default: Any, is_of_kind: Callable[[Any], bool], kind: str) -> Any:
        value = self.get(path, default)
        if not is_of_kind(value):
            self.lose(path, f"expected {kind}")
            return default
        return value

    def given(self, path: str) -> bool:
        """Return True if the file sets it to another value than legged_gym does."""
        found = self.theirs[path]
        return bool(found.why_unknown) or plain(found.value) != plain(value_at(OF_LEGGED_GYM, path))

    def lose(self, path: str, reason: str) -> None:
        """Record a setting of the file as lost."""
        self.done.add(path)
        found = self.theirs[path]
        entry = Lost(found.place, path, "" if found.why_unknown else shown(found.value), reason)
        if entry not in self.lost:
            self.lost.append(entry)

    def put(self, path: str, value: Any, theirs: str, comment: str = "") -> None:
        """Set `path` here, unless the value is the default; a value that the schema refuses is recorded as lost."""
        self.done.add(theirs)
        value = plain(value)
        try:
            build(LeggedConfig, nest(path, value), "", Origins(), "value")
        except ConfigError as error:
            reason = str(error).removeprefix(f"value: {path}: ")
            self.lose(theirs, f"{path} takes no such value: {reason}") if theirs in self.theirs else None
            return
        default = value_at(DEFAULTS, path)
        if _same(value, 1.0 if default is None and path.startswith("observations.scales.") else default):
            self.settings.pop(path, None)  # remove the value from another setting of the file
            return
        self.settings[path] = value
        if comment:
            self.comments[path] = comment

    def take(self, table: Mapping[str, str]) -> None:
        """Map the settings of a table that the file sets."""
        for theirs, ours in table.items():
            found = self.theirs.get(theirs)
            if found is None:
                continue
            if found.why_unknown:
                self.lose(theirs, found.why_unknown)
            else:
                self.put(ours, found.value, theirs)

    def note(self, subject: str, *lines: str) -> None:
        """Add lines about a subject to the report."""
        self.notes.setdefault(subject, []).extend(lines)


def is_number(value: Any) -> bool:
    """Return True if a value is a finite number and not a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST_NUMBER


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) and is_number(item) for name, item in value.items())


def plain(value: Any) -> Any:
    """Return a value that can be compared and written: lists for tuples, no negative zeros."""
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return 0.0 if value == 0 and isinstance(value, float) else value


def _same(value: Any, default: Any) -> bool:
    """Return True if a value is the default; half a turn is 3.14 in legged_gym."""
    if isinstance(value, list) and isinstance(default, list | tuple) and len(value) == len(default):
        return all(_same(a, b) for a, b in zip(value, default, strict=True))
    if isinstance(value, int | float) and isinstance(default, int | float) and not isinstance(value, bool):
        half_turn = abs(value) == PI and abs(abs(default) - math.pi) < 1e-6 and value * default > 0
        return value == default or half_turn
    return bool(value == default)
