"""Constants of a control step: Python numbers as tensors that are on the device before a CUDA graph is captured."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from legged.errors import HostReadError


class Constants:
    """Cache of tensors made from the step's Python numbers. Each tensor is made once on the device, because a graph can't
    copy from the host.

    Lists and numpy arrays in an index become tensors of positions. A list of bools becomes the positions of its True values,
    so that the size of the result is known. Calls such as `torch.tensor` return copies of a cached constant.
    """

    def __init__(self) -> None:
        self._made: dict[Any, Tensor] = {}
        self.complete = False
        """True once all constants exist. If a new constant is needed then, the step's numbers change from step to step."""
        self.making = False
        """True while a constant is being made."""

    def __len__(self) -> int:
        return len(self._made)

    def get(self, key: Any, make: Callable[[], Tensor]) -> Tensor:
        """Return the constant of `key`. If it is missing, make it first.

        Raises:
            HostReadError: the constant is missing, although all constants should exist (`complete`).
        """
        if key not in self._made:
            if self.complete:
                raise HostReadError(
                    "makes a tensor from numbers that differ from the previous step's; a CUDA graph repeats the old numbers"
                )
            with self._free(), torch.inference_mode(False):  # autograd can't keep tensors made in inference mode
                self._made[key] = make()
        return self._made[key]

    @contextmanager
    def _free(self) -> Iterator[None]:
        """Switch off the guard's checks in the block."""
        self.making = True
        try:
            yield
        finally:
            self.making = False

    def pick(self, tensor: Tensor, index: Any) -> tuple[Tensor, Any]:
        """Return a tensor and an index that select the same values as `tensor[index]`, but without scalar tensors in the
        index. torch would read a scalar tensor, as in `forces[:, feet[0]]`, on the host.
        """
        parts = index if isinstance(index, tuple) else (index,)
        for place, part in enumerate(parts):
            if _is_number(part) and part.device == tensor.device:
                before, after = parts[:place], parts[place:]
                from_behind = any(other is Ellipsis for other in before)
                dim = tensor.dim() - sum(map(_dimensions, after)) if from_behind else sum(map(_dimensions, before))
                tensor = tensor[(*[slice(None)] * dim, part.view(1).long())]  # torch refuses int8 and int16 in an index
                parts = (*before, 0, *after[1:])
        return tensor, parts if isinstance(index, tuple) else parts[0]

    def index(self, tensor: Tensor, index: Any) -> Any:
        """Return an equivalent index of `tensor` without lists, arrays, or tensors of another device."""
        parts = index if isinstance(index, tuple) else (index,)
        if any(isinstance(part, list | tuple) and holds_tensors(part) for part in parts):
            raise HostReadError("indexes by a list of tensors: a CUDA graph cannot hold their values; use torch.stack")
        if isinstance(index, list) and any(not isinstance(value, int | np.integer | np.bool_) for value in index):
            return index  # torch reads most such lists as tuples, and warns
        pieces = tuple(piece for part in parts for piece in self._positions(tensor, index, part))
        return pieces if isinstance(index, tuple) or len(pieces) != 1 else pieces[0]

    def _positions(self, tensor: Tensor, index: Any, part: Any) -> tuple[Any, ...]:
        """Return the parts that replace `part` in an index of `tensor`; a list of bools gives one for each dimension."""
        elsewhere = isinstance(part, Tensor) and part.device != tensor.device
        if not elsewhere and not isinstance(part, list | tuple | range | np.ndarray):
            return (part,)
        with self._free():
            array = np.asarray(part)
        if array.dtype == bool:
            if not self.complete:  # let torch raise its own error for a mask of the wrong shape
                with self._free():
                    torch.empty(1, device="cpu").expand(tensor.shape).__getitem__(index)
            return tuple(self._constant(rows, tensor.device) for rows in np.nonzero(array))
        if array.size and (array.dtype.kind not in "iu" or array.dtype == np.uint8):  # torch reads bytes as bools
            return (part,)
        return (int(array),) if array.ndim == 0 else (self._constant(array, tensor.device),)

    def _constant(self, positions: np.ndarray, device: torch.device) -> Tensor:
        positions = positions.astype(np.int64)
        key = ("index", positions.shape, positions.tobytes(), device)
        return self.get(key, lambda: torch.tensor(positions, device=device))


def _is_number(part: Any) -> bool:
    """Return True if a part of an index is a scalar integer tensor."""
    kinds = (torch.int64, torch.int32, torch.int16, torch.int8)
    return isinstance(part, Tensor) and part.dim() == 0 and part.dtype in kinds


def _dimensions(part: Any) -> int:
    """Return the number of a tensor's dimensions that one part of an index uses up."""
    if part is None or part is Ellipsis or isinstance(part, bool):
        return 0
    is_mask = isinstance(part, Tensor | np.ndarray) and part.dtype in (torch.bool, torch.uint8, np.bool_)
    return part.ndim if is_mask else 1


def holds_tensors(data: Any) -> bool:
    """Return True if nested lists contain a tensor."""
    return isinstance(data, Tensor) or (isinstance(data, list | tuple) and any(holds_tensors(value) for value in data))


def key_of(data: Any) -> Any:
    """Return a key that identifies the values of a number, a nested list or an array; None for other types."""
    if isinstance(data, np.ndarray):
        return data.dtype.str, data.shape, data.tobytes()
    if isinstance(data, list | tuple | range):
        keys = tuple(key_of(value) for value in data)
        return None if None in keys else keys
    return (type(data), repr(data)) if isinstance(data, bool | int | float | complex | np.generic) else None
