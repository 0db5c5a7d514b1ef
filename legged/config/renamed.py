"""Names that settings used to have: files written before they were renamed still load."""

from collections.abc import Mapping
from typing import Any

from legged.config.checks import shown
from legged.errors import ConfigError

RENAMED = {
    "observations.actor": "observations.groups.actor.terms",
    "observations.actor_history": "observations.groups.actor.history",
    "observations.critic": "observations.groups.critic.terms",
}
"""Dotted path as it was -> as it is."""
REPLACED: dict[str, tuple[str, dict[str, str | None]]] = {
    "sim.constraint_solver": ("sim.step", {"auto": None, "fused": "fused", "rounds": "library"}),
    "sim.smooth_dynamics": ("sim.step", {"auto": None, "fused": "fused", "stages": "library"}),
}
"""Dotted path as it was -> what took its place, and what its values mean there; None where nothing need be set."""


def renamed(data: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return `data` with its old names replaced; it is not changed.

    Raises:
        ConfigError: a setting is there by its old and by its new name; begins with `source`.
    """
    result = _replaced(data, source)
    for old, new in RENAMED.items():
        section, _, key = old.rpartition(".")
        found = result.get(section)
        if not isinstance(found, Mapping) or key not in found:
            continue
        value = found[key]
        result[section] = {name: item for name, item in found.items() if name != key}
        _put(result, new.split("."), value, f"{source}: {old}: {shown(value)}: this is {new} now, which is set too")
    return result


def _replaced(data: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return a copy of `data` in which settings that others took the place of are expressed by those."""
    result = dict(data)
    for old, (new, meanings) in REPLACED.items():
        section, _, key = old.rpartition(".")
        found = result.get(section)
        if not isinstance(found, Mapping) or key not in found:
            continue
        value, name = found[key], new.rpartition(".")[2]
        rest = {other: item for other, item in found.items() if other != key}
        if not isinstance(value, str) or value not in meanings:
            raise ConfigError(f"{source}: {old}: {new} has taken its place: auto, fused or library; got {shown(value)}")
        meaning = meanings[value]
        if meaning is not None and rest.get(name, meaning) != meaning:
            raise ConfigError(f"{source}: {old}: {shown(value)} means {new}={meaning} now, and {new} is {shown(rest[name])}")
        result[section] = rest if meaning is None else {**rest, name: meaning}
    return result


def _put(data: dict[str, Any], path: list[str], value: Any, conflict: str) -> None:
    """Put a value at a path of keys, copying the maps on the way."""
    key, *rest = path
    if not rest:
        if key in data:
            raise ConfigError(conflict)
        data[key] = value
        return
    inner = data.get(key, {})
    if not isinstance(inner, Mapping):
        raise ConfigError(conflict)
    data[key] = dict(inner)
    _put(data[key], rest, value, conflict)
