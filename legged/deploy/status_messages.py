"""Status lines for the operator, printed by a thread so that the control loop never waits for the terminal."""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress

END_S = 1.0
"""Time for the last lines to be printed at the end [s]."""


class StatusMessages:
    """Prints lines in its own thread, so that a held (Ctrl-S), closed or slow terminal does not delay the robot."""

    def __init__(self, say: Callable[[str], object] | None = None) -> None:
        """Start the thread; `say` prints a line, by default to standard output."""
        self._say = say or (lambda line: print(line, flush=True))
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="status_messages", daemon=True)
        self._thread.start()

    def __call__(self, line: str) -> None:
        """Queue a line."""
        self._lines.put(line)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            with suppress(OSError, ValueError):  # the terminal is closed
                self._say(line)

    def close(self) -> None:
        """Wait until all lines are printed, at most `END_S`."""
        self._lines.put(None)
        self._thread.join(END_S)
