"""Gradients on a CPU: a mini-batch is split into chunks that fit a core's cache, and threads compute their gradients."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

CHUNK = 2048
"""Most rows of a chunk. The activations of a chunk stay in the cache of a core, those of a whole mini-batch do not."""
Chunks = list[tuple[float, Sequence[Tensor]]]
"""Chunks of a mini-batch: share of its rows, and tensors."""


class RowThreads:
    """Threads that compute the gradient of a mean over rows.

    Chunks have a fixed size and their gradients are added in order, so the result does not depend on the number of threads. A
    core that other programs use too computes fewer chunks.
    """

    def __init__(self, count: int | None = None) -> None:
        """Take the number of threads. With None, mini-batches are not split, as is best on a GPU."""
        self._splits = count is not None
        several = count is not None and count > 1
        self._pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) if several else None

    def chunks(self, batch: Sequence[Tensor]) -> Chunks:
        """Split a mini-batch. Its tensors have n rows, or 2 n, if mirror images of the rows follow them. A chunk has the same
        rows of all tensors.
        """
        rows, most = min(map(len, batch)), max(map(len, batch))
        size = max(CHUNK * rows // most, 1) if self._splits else rows
        if size >= rows:
            return [(1.0, batch)]
        parts = [x.unflatten(0, (-1, rows)).split(size, dim=1) for x in batch]
        return [(own[0].shape[1] / rows, [x.flatten(0, 1) for x in own]) for own in zip(*parts, strict=True)]

    def backward(
        self,
        gradients: Callable[..., tuple[Sequence[Tensor | None], Tensor]],
        chunks: Chunks,
        parameters: Sequence[torch.nn.Parameter],
    ) -> Tensor:
        """Add the gradient of a mini-batch's loss to the `parameters`, and return the figures (K,) of the mini-batch.

        `gradients` takes the tensors of a chunk. It returns a gradient or None for each parameter, and the figures (K,), all
        of them means over the rows.
        """
        results = (self._pool.map if self._pool else map)(lambda chunk: gradients(*chunk[1]), chunks)
        total: Tensor | None = None
        for (share, _), (found, figures) in zip(chunks, results, strict=True):
            own = figures if share == 1.0 else share * figures
            total = own if total is None else total + own
            for parameter, gradient in zip(parameters, found, strict=True):
                if gradient is not None and parameter.grad is not None:
                    parameter.grad.add_(gradient, alpha=share)
                elif gradient is not None:
                    parameter.grad = gradient if share == 1.0 else share * gradient
        assert total is not None
        return total
