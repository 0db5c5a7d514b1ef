"""How many threads compute an update on the CPU: as many as there are cores, unless one is faster because others are busy."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

SLOWER = 1.3
"""An update that takes so many times as long as the best with as many threads means that the machine is shared."""
LOOK_AGAIN = 20
"""Updates with one thread after which all are tried again."""


class UpdateThreads:
    """Chooses the number of torch's threads for each update by how long the last ones took.

    With several threads an operation ends when the slowest has its core; beside another program that takes one core of two,
    one thread is faster. For networks and batches as ours the numbers are the same however many threads compute them.
    """

    def __init__(self, most: int, clock: Callable[[], float] = time.perf_counter) -> None:
        """`most` are the cores that may be used; `clock` gives seconds."""
        self._most, self._clock = max(most, 1), clock
        self._last: dict[int, float] = {}
        self._best: dict[int, float] = {}
        self._since = 0
        self.count = self._most
        """Threads of the next update."""

    @contextmanager
    def use(self) -> Iterator[None]:
        """Compute an update in the block; elsewhere torch uses one thread, and the cores are left to physics."""
        before = torch.get_num_threads()
        torch.set_num_threads(self.count)
        start = self._clock()
        try:
            yield
        finally:
            torch.set_num_threads(before)
        self._took(self._clock() - start)

    def _took(self, seconds: float) -> None:
        used = self.count
        self._last[used] = seconds
        self._best[used] = min(seconds, self._best.get(used, seconds))
        self._since += 1
        if self._most == 1:
            return
        if used == self._most:
            shared = seconds > SLOWER * self._best[used]
            unknown = 1 not in self._last
            # Try one thread once, and again whenever all of them have become slow.
            self.count = 1 if shared or unknown or self._last[1] < seconds else self._most
            if self.count == 1:
                self._since = 0
            return
        if seconds >= self._last[self._most] or self._since >= LOOK_AGAIN:
            self.count = self._most
