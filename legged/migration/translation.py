"""A task made from a fork's configuration: settings, comments on them, and lost settings."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from legged.config.checks import build, shown
from legged.config.dotted import value_at
from legged.config.legged import LeggedConfig
from legged.config.loader import nest, to_dict
from legged.errors import ConfigError
from legged.migration.reading import Found

DEFAULTS = to_dict(LeggedConfig())
LIKE_DEFAULTS = {"commands.ranges.heading": [-3.14, 3.14], "train.runner.experiment_name": "test"}
"""Setting of this package -> legged_gym's default, which counts as equal to the default of this package."""


@dataclass(frozen=True)
class Lost:
    """Setting of a fork that has no counterpart in this package, or whose counterpart has another meaning."""

    place: str
    setting: str
    value: str
    reason: str
    """Reason for the loss, or the nearest setting of this package; empty if no setting is near."""

    def __str__(self) -> str:
        value = f" = {self.value}" if self.value else ""
        return f"{self.place}: {self.setting}{value}: {self.reason or 'no setting here has that meaning'}"


@dataclass
class Translation:
    """A task that is made from a fork's configuration."""

    theirs: dict[str, Found]
    """Settings of the environment and of the learner, by dotted path."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Dotted path in this package -> value that differs from the default."""
    comments: dict[str, str] = field(default_factory=dict)
    """Dotted path in this package -> comment on the value."""
    lost: list[Lost] = field(default_factory=list)
    minor: list[str] = field(default_factory=list)
    """Paths of lost settings that change no task."""
    done: set[str] = field(default_factory=set)
    """Dotted paths of the file's settings that were handled."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """Subject (rewards, observations, robot, ...) -> lines about the subject. The report begins with these lines."""

    def get(self, path: str, default: Any = None) -> Any:
        """Return the fork's value of the setting `path`, or `default` if the value is missing, unknown or of the wrong kind.
        If `default` is a float, a list or a table, the value must be a number, a list of numbers or a table of numbers. A
        value that is unknown or of the wrong kind is recorded as lost.
        """
        self.done.add(path)
        found, kind, fits = self.theirs.get(path), "", True
        if found is None:
            return default
        value = found.value
        if isinstance(default, float):
            kind, fits = "a number", is_number(value)
        elif isinstance(default, list):
            kind, fits = "a list of numbers", isinstance(value, list) and all(map(is_number, value))
        elif isinstance(default, dict):
            kind, fits = "names and their numbers", isinstance(value, dict) and all(map(is_number, value.values()))
            value = {name: float(number) for name, number in value.items()} if fits else value
        if found.why_unknown or not fits:
            self.lose(path, found.why_unknown or f"expected {kind}")
            return default
        return value

    def has(self, *paths: str) -> str | None:
        """Return the first of these settings that the file has."""
        return next((path for path in paths if path in self.theirs), None)

    def lose(self, path: str, reason: str) -> None:
        """Record a setting of the file as lost."""
        self.done.add(path)
        found = self.theirs[path]
        entry = Lost(found.place, path, "" if found.why_unknown else shown(found.value), reason)
        if entry not in self.lost:
            self.lost.append(entry)

    def put(self, path: str, value: Any, theirs: str, comment: str = "") -> None:
        """Set `path` to `value`, which comes from the fork's setting `theirs`. If `value` is not allowed, record a loss."""
        self.done.add(theirs)
        try:
            build(LeggedConfig, nest(path, value), "value")
        except ConfigError as error:
            reason = str(error).removeprefix(f"value: {path}: ")
            self.lose(theirs, f"{path} refuses this value: {reason}") if theirs in self.theirs else None
            return
        default = value_at(DEFAULTS, path)
        if default is None and path.startswith("observations.scales."):
            default = 1.0
        if value in (default, LIKE_DEFAULTS.get(path, default)):
            self.settings.pop(path, None)  # another setting of the fork may have set `path`
            return
        self.settings[path] = copy.deepcopy(value)  # YAML would write a repeated list as an alias
        if comment:
            self.comments[path] = comment

    def take(self, table: Mapping[str, str]) -> None:
        """Map the fork's settings that are in `table`: path in the fork -> path in this package."""
        for theirs, ours in table.items():
            found = self.theirs.get(theirs)
            if found is not None and found.why_unknown:
                self.lose(theirs, found.why_unknown)
            elif found is not None:
                self.put(ours, found.value, theirs)

    def note(self, subject: str, *lines: str) -> None:
        """Add lines about a subject to the report."""
        self.notes.setdefault(subject, []).extend(lines)


def is_number(value: Any) -> bool:
    """Return True if a value is a number of plausible size. A bool is not a number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12
