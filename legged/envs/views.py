"""Tensors of names in legged_gym: one that is read-only, and one that has another axis there."""

import re
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from legged.graph.guard import memory_of

WRITES = re.compile(r"__setitem__|__i(add|sub|mul|truediv|floordiv|mod|pow|and|or|xor)__|.*[^_]_")
"""Names of the methods that write to their tensor."""


class ReadOnly(Tensor):
    """Value of an attribute that is computed at each reading. Writing to this tensor or to a view of it would not change the
    task, so it raises an AttributeError that names an alternative. Results computed from the tensor are ordinary tensors.
    """

    instead: str = ""
    w_last = True
    """Quaternions in it have w last, so that functions of legged.math refuse them."""

    @classmethod
    def of(cls, tensor: Tensor, instead: str) -> "ReadOnly":
        """Return a read-only view of `tensor`. An attempt to write raises an AttributeError with the text `instead`."""
        result = tensor.as_subclass(cls)
        result.instead = instead
        return result

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        writes = WRITES.fullmatch(getattr(func, "__name__", ""))
        first = args[0] if args else None
        for target in (first if writes else None, kwargs.get("out")):
            if isinstance(target, cls):
                raise AttributeError(target.instead)
        with torch._C.DisableTorchFunctionSubclass():
            result = func(*args, **kwargs)
            if isinstance(first, cls) and type(result) is Tensor and memory_of(first) == memory_of(result):
                return cls.of(result, first.instead)
        return result


class Wide(Tensor):
    """Tensor that can also be indexed in the layout of forks in which it has one more axis. In all else it is an ordinary
    tensor, and so are the results computed from it.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]
    there: Callable[[], Tensor]

    @classmethod
    def of(cls, tensor: Tensor, there: Callable[[], Tensor]) -> "Wide":
        """Return a view of `tensor` whose parts `[i, j, ...]` are those of `there()` if there are more indices than axes."""
        result = tensor.as_subclass(cls)
        result.there = there
        return result

    def __getitem__(self, index: Any) -> Tensor:
        more = isinstance(index, tuple) and len(index) > self.dim() and not any(i is None or i is ... for i in index)
        return self.there()[index] if more else super().__getitem__(index)
