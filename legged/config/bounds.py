"""Bounds of the schema's numbers: what is beyond them is a slip of the pen, and would end in an overflow or out of memory.

Bounds hold for every item of a list and every value of a map; a list with any bound must not be empty, unless they say so.
"""

from typing import Any

Bounds = dict[str, Any]

FLOAT32_MAX = 3.4e38
"""What no number may exceed: tensors are float32."""
SMALLEST = 1e-9
"""Lowest value of a quantity that must be positive; many are divided by."""
LONGEST_S = 1e9
"""Longest time, for what is never to happen [s]."""
LARGEST = 1e6
"""Largest scale, gain or limit: its square still leaves room in float32."""


def between(low: float, high: float) -> Bounds:
    """Return metadata: from `low` to `high`, both included."""
    return {"min": low, "max": high}


def positive(high: float, low: float = SMALLEST) -> Bounds:
    """Return metadata: above 0, from `low` to `high`."""
    return {"above": 0, "min": low, "max": high}


def items(most: int, bounds: Bounds | None = None) -> Bounds:
    """Return metadata: a list of 1 to `most` items, each within `bounds`."""
    return {"items": most, **(bounds or {})}


def quantity(unit: str, bounds: Bounds) -> Bounds:
    """Return metadata: a quantity of `unit`, within `bounds`."""
    return {**bounds, "unit": unit}


def rescaled(unit: str, bounds: Bounds) -> Bounds:
    """Return metadata: a quantity of `unit` that grows with the robot (rescale.py), within `bounds`."""
    return {**quantity(unit, bounds), "rescaled": unit}


def rescaled_by_term(prefix: str, power: int, bounds: Bounds) -> Bounds:
    """Return metadata: for each term a number that grows with that power of what the method `<prefix><term>` returns."""
    return {**bounds, "unit_of": (prefix, power)}


def rescaled_by_entry(path: str, bounds: Bounds) -> Bounds:
    """Return metadata: for each entry of the map at the dotted `path` numbers that grow with the entry's unit."""
    return {**bounds, "unit_of": (f"{path}.", 1)}


UNIT = between(0, 1)
NAME: Bounds = {"name": True}
"""Text that becomes the name of a folder; it may be empty."""
NAMES = items(1000)
"""A list of texts, none of them twice."""
NAMES["unique"] = True
TERMS: Bounds = {**NAMES, "may_be_empty": True}
"""The same, or none at all."""
