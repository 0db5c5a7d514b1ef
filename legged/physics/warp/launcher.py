"""Launches of Warp kernels on torch tensors."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import warp as wp
from torch import Tensor

MOST_PREPARED = 200
"""Largest number of recorded launches per task."""


class Launcher:
    """Launches kernels on an engine's device, on torch's current stream."""

    def __init__(self, on_device: Callable[[], AbstractContextManager[Any]]) -> None:
        """Make all launches within the context that `on_device` returns."""
        self._on_device = on_device
        self._prepared: dict[tuple[Any, ...], Any] = {}
        """Recorded CPU launches by kernel, dimension and arguments."""

    def launch(
        self, kernel: Any, dim: int | tuple[int, ...], arguments: tuple[Tensor | float, ...], vectors: int = 0
    ) -> None:
        """Launch a kernel. The first `vectors` of its arguments are arrays of vectors (..., 3).

        On a CPU the launch is recorded, because preparing it takes longer than running it. The next call with the same
        kernel, dimension and tensors replays it.
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
                # The table fills up only if each step creates new tensors. Old launches are then useless, and are dropped.
                if len(self._prepared) >= MOST_PREPARED:
                    self._prepared.clear()
                self._prepared[key] = prepared


def _identity(argument: Tensor | float) -> Any:
    """Return a number unchanged. For a tensor, return the properties that a recorded launch depends on."""
    if isinstance(argument, Tensor):
        return argument.data_ptr(), argument.shape, argument.stride(), argument.dtype
    return argument


def _of_torch(argument: Tensor | float, vectors: bool) -> Any:
    """Return the kernel argument for a torch tensor or a number."""
    if not isinstance(argument, Tensor):
        return argument
    return wp.from_torch(argument, dtype=wp.vec3) if vectors else wp.from_torch(argument)
