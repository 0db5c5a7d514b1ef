"""Bounds of the schema's numbers. A value beyond its bounds is most likely a typo. It would cause an overflow or fill the
memory.

Bounds hold for every item of a list and every value of a map. A list with bounds must not be empty, unless the bounds
contain `may_be_empty`.
"""

from typing import Any

Bounds = dict[str, Any]

FLOAT32_MAX = 3.4e38
"""Largest number in any setting, because tensors are float32."""
SMALLEST = 1e-9
"""Smallest value of a positive quantity. Many such quantities are divisors, and a smaller divisor could cause an overflow."""
LONGEST_S = 1e9
"""Longest time [s]. An event with this interval never happens in practice."""
LARGEST = 1e6
"""Largest scale, gain or limit. Its square still fits float32."""


def between(low: float, high: float) -> Bounds:
    """Return metadata of a number from `low` to `high`, both included."""
    return {"min": low, "max": high}


def positive(high: float, low: float = SMALLEST) -> Bounds:
    """Return metadata of a number above 0, from `low` to `high`."""
    return {"above": 0, "min": low, "max": high}


def items(most: int, bounds: Bounds) -> Bounds:
    """Return metadata of a list of 1 to `most` items, each within `bounds`."""
    return {"items": most, **bounds}


def quantity(unit: str, bounds: Bounds) -> Bounds:
    """Return metadata of a quantity in the unit `unit`, within `bounds`."""
    return {**bounds, "unit": unit}


def rescaled(unit: str, bounds: Bounds) -> Bounds:
    """Return metadata like `quantity`, for a quantity that is rescaled for another robot (rescale.py)."""
    return {**quantity(unit, bounds), "rescaled": unit}


def rescaled_by_entry(prefix: str, bounds: Bounds, power: int = 1) -> Bounds:
    """Return metadata of a map: name -> number. The numbers are rescaled for another robot. Each number has its own unit: the
    unit of `<prefix><name>`, raised to `power`. This is a method that declares the unit, such as "_reward_torques", or the
    dotted path of an entry, such as "terrain.sizes.step".
    """
    return {**bounds, "unit_of": (prefix, power)}


UNIT = between(0, 1)
NAME: Bounds = {"name": True}
"""Metadata of a text that is the name of a folder. The text may be empty."""
NAMES = items(1000, {"unique": True})
"""Metadata of a list of texts without duplicates. The list must not be empty."""
TERMS: Bounds = {**NAMES, "may_be_empty": True}
"""Metadata of a list of texts without duplicates. The list may be empty."""
