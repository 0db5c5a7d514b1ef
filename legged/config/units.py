"""Physical units as texts, and the scaling of quantities with the size of a robot."""

import re
from collections.abc import Mapping

BASE = {
    "m": (0, 1, 0),
    "cm": (0, 1, 0),
    "mm": (0, 1, 0),
    "kg": (1, 0, 0),
    "s": (0, 0, 1),
    "N": (1, 1, -2),
    "Nm": (1, 2, -2),
    "J": (1, 2, -2),
    "W": (1, 2, -3),
    "Hz": (0, 0, -1),
    "rad": (0, 0, 0),
    "deg": (0, 0, 0),
    "1": (0, 0, 0),
}
"""Unit -> exponents of mass, length and time. Angles have no dimension."""
Exponents = tuple[int, int, int]
SPELLINGS = {"**": "^", "*": " ", "·": " ", "²": "^2", "³": "^3", "⁴": "^4", "⁻": "^-", "^-^": "^-", "¹": "1"}
"""Accepted spelling of a power or product -> the spelling that `_parsed` reads."""
TOKENS = re.compile(r"[A-Za-z]+|\^-?\d+|\S")


def exponents(unit: str) -> Exponents:
    """Return the exponents of mass, length and time of a unit such as "N^2 m^2", "rad/s^2" or "(m/s)^2". If there are several
    units, separated by commas, the first counts. A text that is not a unit gives (0, 0, 0).
    """
    return _parsed(unit.partition(",")[0]) or (0, 0, 0)


def is_unit(text: str) -> bool:
    """Return True if a text is a unit, or several units separated by commas."""
    return all(part.strip() and _parsed(part) is not None for part in text.split(","))


def _parsed(text: str) -> Exponents | None:
    """Return the exponents of mass, length and time of one unit; None for a text that is not a unit."""
    for theirs, ours in SPELLINGS.items():
        text = text.replace(theirs, ours)
    words = TOKENS.findall(text)
    found = _product(words)
    return None if words else found


def _product(words: list[str]) -> Exponents | None:
    """Remove a product of units from the front of `words`, up to a closing bracket. Return the exponents of the product; None
    if a word is not a unit. Everything after a slash is in the denominator.
    """
    mass, length, time, sign = 0, 0, 0, 1
    while words and words[0] != ")":
        word = words.pop(0)
        if word == "/":
            sign = -1
            continue
        part = _product(words) if word == "(" else BASE.get(word)
        if part is None or (word == "(" and not words):
            return None
        if word == "(":
            words.pop(0)
        power = sign * (int(words.pop(0)[1:]) if words and words[0][0] == "^" and words[0] != "^" else 1)
        mass, length, time = mass + power * part[0], length + power * part[1], time + power * part[2]
    return mass, length, time


def factor(unit: str, scale: Mapping[str, float]) -> float:
    """Return the factor on a quantity of `unit` if masses, lengths and times are multiplied by scale["kg"], scale["m"] and
    scale["s"].
    """
    mass, length, time = exponents(unit)
    return float(scale["kg"] ** mass * scale["m"] ** length * scale["s"] ** time)
