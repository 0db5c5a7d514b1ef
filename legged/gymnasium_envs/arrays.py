"""Tensors as Gymnasium has them: NumPy arrays, in dictionaries or not."""

from typing import Any

import numpy as np
from torch import Tensor


def as_numpy(value: Any) -> Any:
    """Return a tensor, or the tensors of a dictionary, as arrays; of a tensor on the CPU the memory is shared."""
    if isinstance(value, dict):
        return {name: as_numpy(part) for name, part in value.items()}
    return value.cpu().numpy() if isinstance(value, Tensor) else value


def row(value: Any, index: int) -> Any:
    """Return one row of an array, or of the arrays of a dictionary."""
    return {name: part[index] for name, part in value.items()} if isinstance(value, dict) else value[index]


def rows_of(value: Any, mask: np.ndarray) -> np.ndarray:
    """Return an array (N,) of objects, as Gymnasium has final observations: copies of the rows of `mask` (N,), else None."""
    found = np.full(len(mask), None, dtype=object)
    for index in mask.nonzero()[0].tolist():
        one = row(value, index)
        found[index] = {name: part.copy() for name, part in one.items()} if isinstance(one, dict) else one.copy()
    return found
