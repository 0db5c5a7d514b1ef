"""Random numbers of a single environment: tasks draw from torch's generators, which are global to the process."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class RandomStream:
    """States of torch's generators for the CPU and one GPU, which are active only inside `used`."""

    def __init__(self, device: torch.device) -> None:
        """Start from the state that torch's generators have at the first use."""
        self._device = device
        self._states: list[Tensor] | None = None

    @contextmanager
    def used(self) -> Iterator[None]:
        """Let torch draw from this stream inside the block; restore the global state afterwards."""
        outside = self._read()
        if self._states is not None:
            self._write(self._states)
        try:
            yield
        finally:
            self._states = self._read()
            self._write(outside)

    def seed(self, seed: int) -> None:
        """Restart the stream from a seed."""
        with self.used():
            torch.random.default_generator.manual_seed(seed)
            if self._device.type == "cuda":
                with torch.cuda.device(self._device):
                    torch.cuda.manual_seed(seed)

    def _read(self) -> list[Tensor]:
        on_gpu = [torch.cuda.get_rng_state(self._device)] if self._device.type == "cuda" else []
        return [torch.get_rng_state(), *on_gpu]

    def _write(self, states: list[Tensor]) -> None:
        torch.set_rng_state(states[0])
        if self._device.type == "cuda":
            torch.cuda.set_rng_state(states[1], self._device)
