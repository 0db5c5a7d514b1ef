"""Access to settings in nested mappings by dotted path: one setting, all settings, and differences."""

from collections.abc import Mapping, Sequence
from typing import Any


class _Missing:
    def __repr__(self) -> str:
        return "nothing"


MISSING = _Missing()
"""Value of a setting that a configuration lacks."""


def value_at(values: Any, path: str) -> Any:
    """Return the value at a dotted path of nested mappings, or None if there is no value."""
    for key in path.split("."):
        values = values.get(key) if isinstance(values, dict) else None
    return values


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return dotted path -> value for all settings. A list or an empty mapping counts as one value."""
    if not isinstance(config, Mapping) or (not config and prefix):
        return {prefix: config}
    return {
        path: value for key, entry in config.items() for path, value in flat(entry, f"{prefix}.{key}".lstrip(".")).items()
    }


def differences(configs: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the settings that differ: dotted path -> list of the values in all `configs`. The value is MISSING where a
    configuration lacks the setting. An empty mapping is not compared if the mapping has settings in another configuration.
    """
    all_flat = [flat(config) for config in configs]
    paths = dict.fromkeys(path for one in all_flat for path in one)
    filled = {path[:i] for path in paths for i, letter in enumerate(path) if letter == "."}
    found = {path: [one.get(path, MISSING) for one in all_flat] for path in paths if path not in filled}
    return {path: values for path, values in found.items() if any(not _same(values[0], value) for value in values[1:])}


def _same(a: Any, b: Any) -> bool:
    return (a is b) if MISSING in (a, b) else bool(a == b)
