"""Arrays of numpy in files that are not run: lists whose arithmetic is numpy's, item by item."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

MOST_ITEMS = 10_000
"""Items of a list that an expression makes."""
NUMERIC = "biuf"
"""Kinds of what arithmetic is done with: truths, integers, floats."""


def _made(value: np.ndarray) -> Any:
    """Return an array of numpy as one of these, and a number as Python's."""
    items = value.tolist()
    return Array(items) if isinstance(items, list) else items


def _numeric(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in NUMERIC:
        raise TypeError("arithmetic with an array of something else than numbers")
    return array


def _by_item(function: np.ufunc, swapped: bool = False) -> Callable[["Array", Any], Any]:
    """Return the method of an operator between an array and what is on its other side."""

    def method(self: "Array", other: Any) -> Any:
        one, two = _numeric(self), _numeric(other)
        if np.broadcast(one, two).size > MOST_ITEMS:
            raise ValueError(f"it has more than {MOST_ITEMS} items")
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            return _made(function(two, one) if swapped else function(one, two))

    return method


class Array(list[Any]):
    """An array of numpy. To whoever does no arithmetic with it, it is a list of numbers, or of such lists."""

    def __init__(self, items: Iterable[Any]) -> None:
        """Take the items; lists among them are rows."""
        super().__init__(Array(item) if isinstance(item, list | tuple) else item for item in items)

    def copy(self) -> "Array":
        """Return an array of the same items."""
        return Array(self)

    def tolist(self) -> list[Any]:
        """Return a list of Python's."""
        return [item.tolist() if isinstance(item, Array) else item for item in self]

    def __getitem__(self, key: Any) -> Any:
        return super().__getitem__(key) if isinstance(key, int) else _made(np.asarray(self)[key])

    def __neg__(self) -> Any:
        return _made(-_numeric(self))

    def __pos__(self) -> Any:
        return self.copy()

    def __abs__(self) -> Any:
        return _made(abs(_numeric(self)))

    def __round__(self, digits: int = 0) -> Any:
        return _made(np.round(_numeric(self), digits))

    __add__, __radd__ = _by_item(np.add), _by_item(np.add, swapped=True)
    __sub__, __rsub__ = _by_item(np.subtract), _by_item(np.subtract, swapped=True)
    __mul__, __rmul__ = _by_item(np.multiply), _by_item(np.multiply, swapped=True)
    __truediv__, __rtruediv__ = _by_item(np.divide), _by_item(np.divide, swapped=True)
    __floordiv__, __rfloordiv__ = _by_item(np.floor_divide), _by_item(np.floor_divide, swapped=True)
    __mod__, __rmod__ = _by_item(np.remainder), _by_item(np.remainder, swapped=True)
