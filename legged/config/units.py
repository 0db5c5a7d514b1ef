"""Physical units, as texts: what a number of a configuration measures, and how it changes with the size of a robot."""

import re
from collections.abc import Mapping

BASE = {
    "m": (0, 1, 0),
    "kg": (1, 0, 0),
    "s": (0, 0, 1),
    "N": (1, 1, -2),
    "J": (1, 2, -2),
    "W": (1, 2, -3),
    "Hz": (0, 0, -1),
    "rad": (0, 0, 0),
    "1": (0, 0, 0),
}
"""Unit -> exponents of mass, length and time; an angle is a ratio of lengths."""
Exponents = tuple[int, int, int]


def exponents(unit: str) -> Exponents:
    """Return the exponents of mass, length and time of a unit such as "N^2 m^2" or "rad/s^2"; of several, separated by
    commas, those of the first. What is no unit has none: (0, 0, 0).
    """
    first = unit.partition(",")[0].strip()
    total = [0, 0, 0]
    for i, part in enumerate(first.split("/")):
        for word in part.split():
            match = re.fullmatch(r"([A-Za-z1]+)(?:\^(\d+))?", word)
            if match is None or match.group(1) not in BASE:
                return (0, 0, 0)
            power = int(match.group(2) or 1) * (1 if i == 0 else -1)
            total = [t + power * e for t, e in zip(total, BASE[match.group(1)], strict=True)]
    return (total[0], total[1], total[2])


def unit_in(docstring: str | None) -> str | None:
    """Return the unit with which the first paragraph of a docstring ends, "m/s" of "Speed [m/s]."; None without one."""
    text = " ".join((docstring or "").partition("\n\n")[0].split())
    found = re.search(r"\[([^\]]*)\]\.?$", text)
    return found.group(1) if found else None


def factor(unit: str, scale: Mapping[str, float]) -> float:
    """Return by what a quantity of that unit grows where masses, lengths and times grow by scale["kg"], ["m"] and ["s"]."""
    mass, length, time = exponents(unit)
    return float(scale["kg"] ** mass * scale["m"] ** length * scale["s"] ** time)
