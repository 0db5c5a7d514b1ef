"""Lines for the operator, printed without the program ever waiting for it."""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress

END_S = 1.0
"""What has been said must be printed within so long at the end [s]."""


class Telling:
    """Prints lines from a thread of its own: a terminal that is held (Ctrl-S), closed or slow holds no robot up."""

    def __init__(self, say: Callable[[str], object] | None = None) -> None:
        """Begin; `say` prints a line, by default to standard output."""
        self._say = say or (lambda line: print(line, flush=True))
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="telling", daemon=True)
        self._thread.start()

    def __call__(self, line: str) -> None:
        """Print a line soon."""
        self._lines.put(line)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            with suppress(OSError, ValueError):  # nobody reads it any more
                self._say(line)

    def close(self) -> None:
        """Wait until all is printed, but no longer than `END_S`."""
        self._lines.put(None)
        self._thread.join(END_S)
