"""Old names of settings. Files written before a renaming still load."""

from collections.abc import Mapping
from typing import Any

from legged.config.checks import shown
from legged.errors import ConfigError

RENAMED = {
    "observations.actor": "observations.groups.actor.terms",
    "observations.actor_history": "observations.groups.actor.history",
    "observations.critic": "observations.groups.critic.terms",
}
"""Old dotted path -> new dotted path."""
REPLACED: dict[str, tuple[str, dict[str, str | None]]] = {
    "sim.constraint_solver": ("sim.step", {"auto": None, "fused": "fused", "rounds": "library"}),
    "sim.smooth_dynamics": ("sim.step", {"auto": None, "fused": "fused", "stages": "library"}),
}
"""Old dotted path -> (new dotted path, map: old value -> new value). If the new value is None, the old setting is dropped."""


def renamed(data: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return a copy of `data` with old names replaced.

    Raises:
        ConfigError: `data` has a setting under its old and its new name, or an old setting has an unknown value. The message
            begins with `source`.
    """
    result = _replaced(data, source)
    for old, new in RENAMED.items():
        section, _, key = old.rpartition(".")
        found = result.get(section)
        if not isinstance(found, Mapping) or key not in found:
            continue
        value = found[key]
        result[section] = {name: item for name, item in found.items() if name != key}
        _put(result, new.split("."), value, f"{source}: {old}: {shown(value)}: renamed to {new}, which is set too")
    return result


def _replaced(data: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return a copy of `data` in which each setting of REPLACED is converted to its successor."""
    result = dict(data)
    for old, (new, meanings) in REPLACED.items():
        section, _, key = old.rpartition(".")
        found = result.get(section)
        if not isinstance(found, Mapping) or key not in found:
            continue
        value, name = found[key], new.rpartition(".")[2]
        rest = {other: item for other, item in found.items() if other != key}
        if not isinstance(value, str) or value not in meanings:
            raise ConfigError(f"{source}: {old}: replaced by {new}, which can be auto, fused or library; got {shown(value)}")
        meaning = meanings[value]
        if meaning is not None and rest.get(name, meaning) != meaning:
            raise ConfigError(f"{source}: {old}: {shown(value)} now means {new}={meaning}, but {new} is {shown(rest[name])}")
        result[section] = rest if meaning is None else {**rest, name: meaning}
    return result


def _put(data: dict[str, Any], path: list[str], value: Any, conflict: str) -> None:
    """Set the value at a path of keys. Maps on the path are copied. An existing value raises ConfigError(conflict)."""
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
