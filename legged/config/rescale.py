"""Rescaling of a configuration's numbers from its reference robot to the task's robot, by dynamic similarity.

Only numbers with a unit are rescaled. `rescaled` (bounds.py) sets the unit of a field. Scales, noise and bias of a term are
rescaled by the unit that `@unit` declares above the term's method. Sizes of a terrain have the unit of the terrain type.
Ranges of a property have the unit of the property.
"""

import dataclasses
import typing
from collections.abc import Callable, Mapping
from typing import Any

from legged.config.checks import hints_of

Factor = Callable[[str], float]
"""Function: unit -> factor that converts a quantity of that unit from the reference robot to the task's robot."""
UnitOf = Callable[[str], str]
"""Function: name -> unit. The name is that of a term's method, such as "_reward_torques", or the dotted path of an entry,
such as "terrain.sizes.step"."""
DIGITS = 6
"""Number of significant digits of a rescaled number. More digits would be hard to read."""


def rescale(data: Mapping[str, Any], schema: type, factor: Factor, unit_of: UnitOf) -> dict[str, Any]:
    """Return a copy of `data` in which all numbers with a unit are rescaled. `data` are nested values that fit `schema`."""
    fields = {f.name: f for f in dataclasses.fields(schema)}
    hints = hints_of(schema)
    rescaled: dict[str, Any] = {}
    for key, value in data.items():
        meta = fields[key].metadata
        if dataclasses.is_dataclass(hints[key]):
            rescaled[key] = rescale(value, hints[key], factor, unit_of)  # type: ignore[arg-type]
        elif "rescaled" in meta:
            rescaled[key] = times(value, factor(meta["rescaled"]))
        elif "unit_of" in meta:
            prefix, power = meta["unit_of"]
            rescaled[key] = {
                term: _times_entry(number, factor(unit_of(prefix + term)) ** power) for term, number in value.items()
            }
        elif typing.get_origin(hints[key]) is dict and dataclasses.is_dataclass(kind := typing.get_args(hints[key])[1]):
            rescaled[key] = {name: rescale(section, kind, factor, unit_of) for name, section in value.items()}  # type: ignore[arg-type]
        else:
            rescaled[key] = value
    return rescaled


def _times_entry(value: Any, by: float) -> Any:
    """Return a map's entry times `by`. In a section, only `range` and `std` have the entry's unit and are multiplied."""
    if not isinstance(value, Mapping):
        return times(value, by)
    return {key: times(item, by) if key in ("range", "std") else item for key, item in value.items()}


def times(value: Any, by: float) -> Any:
    """Return `value` with all its numbers multiplied by `by`. A factor of 1 keeps the numbers exactly as written."""
    if by == 1.0:
        return value
    if isinstance(value, Mapping):
        return {key: times(item, by) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [times(item, by) for item in value]
    return float(f"{value * by:.{DIGITS}g}")
