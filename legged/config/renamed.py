"""Old names of settings. Files written before a renaming still load."""

from collections.abc import Mapping
from typing import Any

from legged.config.checks import shown
from legged.config.dotted import value_at
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
        ConfigError: a setting has one value under its old name and another one under its new name, or an old setting has an
            unknown value. The message begins with `source`.
    """
    result = dict(data)
    for old in (*RENAMED, *REPLACED):
        section, _, key = old.rpartition(".")
        found = result.get(section)
        if not isinstance(found, Mapping) or key not in found:
            continue
        value = found[key]
        result[section] = {name: item for name, item in found.items() if name != key}
        where = f"{source}: {old}: {shown(value)}"
        if old in RENAMED:
            _put(result, RENAMED[old], value, f"{where}: renamed to {RENAMED[old]}, which is set too")
            continue
        new, meanings = REPLACED[old]
        if not isinstance(value, str) or value not in meanings:
            raise ConfigError(f"{source}: {old}: replaced by {new}, which can be auto, fused or library; got {shown(value)}")
        if (meaning := meanings[value]) is not None:
            _put(result, new, meaning, f"{where} now means {new}={meaning}, but {new} is {shown(value_at(result, new))}")
    return result


def _put(data: dict[str, Any], path: str, value: Any, conflict: str) -> None:
    """Set the value at a dotted path. Maps on the path are copied. Another value there raises ConfigError(conflict)."""
    key, _, rest = path.partition(".")
    there = data.get(key, {} if rest else value)
    if not (isinstance(there, Mapping) if rest else there == value):
        raise ConfigError(conflict)
    data[key] = dict(there) if rest else value
    if rest:
        _put(data[key], rest, value, conflict)
