"""Launches of Warp kernels on torch's tensors."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import warp as wp
from torch import Tensor

MOST_PREPARED = 200
"""Launches that are kept for one task."""


class Launcher:
    """Launches kernels on an engine's device, on the stream that torch uses now."""

    def __init__(self, on_device: Callable[[], AbstractContextManager[Any]]) -> None:
        """Launch within `on_device`."""
        self._on_device = on_device
        self._prepared: dict[tuple[Any, ...], Any] = {}
        """Launches on a CPU by what they are of, ready to be made again."""

    def launch(
        self, kernel: Any, dim: int | tuple[int, ...], arguments: tuple[Tensor | float, ...], vectors: int = 0
    ) -> None:
        """Launch a kernel, of whose arguments the first `vectors` are arrays of vectors (..., 3).

        On a CPU the launch is kept for the next step, whose tensors are the same: to prepare it takes longer than to make it.
        """
        with self._on_device():
            key = None
            if wp.get_device().is_cpu:
                key = (kernel, dim, *(_identity(a) for a in arguments))
                if prepared := self._prepared.get(key):
                    prepared.launch()
                    return
            inputs = [_of_torch(argument, k < vectors) for k, argument in enumerate(arguments)]
            wp.launch(kernel, dim=dim, inputs=inputs)
            if key is not None and (prepared := wp.launch(kernel, dim=dim, inputs=inputs, record_cmd=True)):
                if len(self._prepared) >= MOST_PREPARED:  # of tensors that are made anew in each step
                    self._prepared.clear()
                self._prepared[key] = prepared


def _identity(argument: Tensor | float) -> Any:
    """Return by what a kernel would know an argument."""
    if isinstance(argument, Tensor):
        return argument.data_ptr(), argument.shape, argument.stride(), argument.dtype
    return argument


def _of_torch(argument: Tensor | float, vectors: bool) -> Any:
    """Return what a kernel takes of an argument."""
    if not isinstance(argument, Tensor):
        return argument
    return wp.from_torch(argument, dtype=wp.vec3) if vectors else wp.from_torch(argument)
