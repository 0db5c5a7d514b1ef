"""NumPy arrays in files that are not run: lists with NumPy's element-wise arithmetic."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

MOST_ITEMS = 10_000
"""Largest number of items of a list that an expression makes."""
NUMERIC = "biuf"
"""NumPy kinds of booleans, integers and floats, which arithmetic is defined for."""


def _made(value: np.ndarray) -> Any:
    """Return a NumPy array as an `Array`, and a NumPy number as a Python number."""
    items = value.tolist()
    return Array(items) if isinstance(items, list) else items


def _numeric(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in NUMERIC:
        raise TypeError("arithmetic with an array that holds other things than numbers")
    return array


def _by_item(function: np.ufunc, swapped: bool = False) -> Callable[["Array", Any], Any]:
    """Return the method of an operator between an array and its other operand."""

    def method(self: "Array", other: Any) -> Any:
        one, two = _numeric(self), _numeric(other)
        if np.broadcast(one, two).size > MOST_ITEMS:
            raise ValueError(f"it has more than {MOST_ITEMS} items")
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            return _made(function(two, one) if swapped else function(one, two))

    return method


class Array(list[Any]):
    """A NumPy array as a list of numbers, or of nested lists; only its arithmetic is NumPy's."""

    def __init__(self, items: Iterable[Any]) -> None:
        """Store the items; nested lists are rows."""
        super().__init__(Array(item) if isinstance(item, list | tuple) else item for item in items)

    def copy(self) -> "Array":
        """Return an array with the same items."""
        return Array(self)

    def tolist(self) -> list[Any]:
        """Return the items as Python lists."""
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
