"""Numbers on their way from a device to the host, in one transfer for which nothing waits until they are needed."""

from collections.abc import Mapping

import torch
from torch import Tensor


class AsyncReadback:
    """The numbers that some tensors of a device have now: at this place in the order of its work, whatever follows."""

    @torch.no_grad()
    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        """Ask for the numbers of `tensors`, by name; on a GPU the host goes on at once."""
        self._sizes = {name: tensor.numel() for name, tensor in tensors.items()}
        self._numbers = torch.cat([tensor.reshape(-1) for tensor in tensors.values()])  # a copy: they may change
        self._arrival: torch.cuda.Event | None = None
        if self._numbers.is_cuda:
            of_device = self._numbers
            self._numbers = torch.empty(of_device.shape, dtype=of_device.dtype, pin_memory=True)
            self._numbers.copy_(of_device, non_blocking=True)
            self._arrival = torch.cuda.Event()
            self._arrival.record()

    def numbers(self) -> dict[str, list[float]]:
        """Return the numbers of each tensor; waits until they are there."""
        if self._arrival is not None:
            self._arrival.synchronize()
        pieces = self._numbers.split(list(self._sizes.values()))
        return {name: piece.tolist() for name, piece in zip(self._sizes, pieces, strict=True)}
