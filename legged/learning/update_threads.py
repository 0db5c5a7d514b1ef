"""Number of threads for an update on the CPU: one per core, or only one if other programs keep the cores busy."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

SLOWER = 1.3
"""If an update with all threads takes more than this factor times the time of the fastest one so far, other programs seem to
keep the cores busy."""
LOOK_AGAIN = 20
"""After this number of updates with one thread, all threads are tried again."""


class UpdateThreads:
    """Chooser of the number of torch threads for the next update. It compares the times of the last updates.

    With several threads an operation ends only when its slowest thread ends. If another program occupies one of two cores,
    one thread is faster. The results do not depend on the number of threads (cpu_layers.py).
    """

    def __init__(self, most: int, clock: Callable[[], float] = time.perf_counter) -> None:
        """Take the number `most` of cores that may be used, and a `clock` that returns seconds."""
        self._most, self._clock = max(most, 1), clock
        self._last: dict[int, float] = {}
        self._best: dict[int, float] = {}
        self._since = 0
        self.count = self._most
        """Number of threads of the next update."""

    @contextmanager
    def use(self) -> Iterator[None]:
        """Set the chosen number of threads for the `with` block, which runs an update, and measure its time. Outside the
        block torch uses one thread, and the other cores do physics.
        """
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
            # Use one thread if this has not been tried, if it was faster, or if all threads have become slow.
            self.count = 1 if shared or unknown or self._last[1] < seconds else self._most
            if self.count == 1:
                self._since = 0
            return
        if seconds >= self._last[self._most] or self._since >= LOOK_AGAIN:
            self.count = self._most
