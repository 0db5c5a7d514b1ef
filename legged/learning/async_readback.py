"""Asynchronous transfer of numbers from a device to the host."""

from collections.abc import Mapping

import torch
from torch import Tensor


class AsyncReadback:
    """Snapshot of some tensors, copied to the host in one transfer. Work that is launched after the constructor does not
    change the snapshot.
    """

    @torch.no_grad()
    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        """Start the transfer of `tensors` (name -> tensor). On a GPU this returns at once."""
        self._sizes = {name: tensor.numel() for name, tensor in tensors.items()}
        self._numbers = torch.cat([tensor.reshape(-1) for tensor in tensors.values()])  # a copy, as the tensors may change
        self._arrival: torch.cuda.Event | None = None
        if self._numbers.is_cuda:
            of_device = self._numbers
            self._numbers = torch.empty(of_device.shape, dtype=of_device.dtype, pin_memory=True)
            self._numbers.copy_(of_device, non_blocking=True)
            self._arrival = torch.cuda.Event()
            self._arrival.record()

    def numbers(self) -> dict[str, list[float]]:
        """Wait for the transfer and return name -> values of the tensor, flattened."""
        if self._arrival is not None:
            self._arrival.synchronize()
        pieces = self._numbers.split(list(self._sizes.values()))
        return {name: piece.tolist() for name, piece in zip(self._sizes, pieces, strict=True)}
