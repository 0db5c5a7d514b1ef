"""Patterns in robot.yaml and in tasks. A pattern matches all names that contain it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from legged.errors import ConfigError, suggest


def match_names(patterns: Sequence[str], names: Sequence[str], where: str) -> tuple[int, ...]:
    """Return the indices of the names that contain any of the patterns, in the order of `names`.

    Raises:
        ConfigError: a pattern is empty or matches no name; `where` is the place of the patterns.
    """
    for pattern in patterns:
        if not pattern:
            raise ConfigError(f"{where}: an empty pattern would match everything{suggest(pattern, names, 'names')}")
        if not any(pattern in name for name in names):
            raise ConfigError(f"{where}: pattern '{pattern}' matches nothing{suggest(pattern, names, 'names')}")
    return tuple(i for i, name in enumerate(names) if any(pattern in name for pattern in patterns))


def match_values(table: Mapping[str, Any], names: Sequence[str], where: str) -> np.ndarray:
    """Return one value for each name, (len(names),). It is the value of the longest pattern that the name contains.

    Raises:
        ConfigError: a pattern matches no name, or no pattern matches a name.
    """
    match_names(tuple(table), names, where)
    values = []
    for name in names:
        matching = [pattern for pattern in table if pattern in name]
        if not matching:
            raise ConfigError(f"{where}: no pattern matches joint '{name}' (patterns: {', '.join(table) or 'none'})")
        values.append(table[max(matching, key=len)])
    return np.array(values)
