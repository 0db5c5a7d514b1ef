"""Real-time operation: process priority, a fixed cycle rate with statistics, and status lines that never delay the robot."""

import os
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np

PRIORITY = 20
"""Real-time priority of the process under Linux's SCHED_FIFO (1 to 99)."""
END_S = 1.0
"""Longest wait at the end of the program until the last status lines are printed [s]."""


def take_priority(priority: int = PRIORITY) -> bool:
    """Request a real-time priority from Linux; return whether it was granted.

    Linux grants the priority to the user NAME if /etc/security/limits.conf has a line `NAME - rtprio 20`.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):  # the system lacks the call, or refuses it
        return False
    return True


class Pace:
    """A clock whose cycles are due every `dt` [s]. A cycle that takes too long does not shift later due times."""

    def __init__(
        self, dt: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], object] = time.sleep
    ) -> None:
        """Prepare the clock; the first call of `wait` begins the first cycle."""
        self._dt, self._clock, self._sleep = dt, clock, sleep
        self._due: float | None = None
        self._began = 0.0
        self.took: list[float] = []
        """Duration of each cycle [s]."""
        self._late: list[float] = []
        self.missed = self.missed_in_a_row = 0
        """Numbers of missed deadlines, in total and in a row. A cycle that takes 2.5 periods misses two deadlines."""

    def wait(self) -> float:
        """Wait until the next cycle is due; return the time at which it begins [s]."""
        now = self._clock()
        if self._due is None:
            self._due = now
        if now < self._due:
            self._sleep(self._due - now)
            now = self._clock()
        self._late.append(max(0.0, now - self._due))
        self._began = now
        return now

    def done(self) -> None:
        """End a cycle. If the next cycle is already due, a deadline is missed. Any further overdue cycles are skipped, and
        their deadlines count as missed too.
        """
        assert self._due is not None
        now = self._clock()
        self.took.append(now - self._began)
        self._due += self._dt
        if now <= self._due:
            self.missed_in_a_row = 0
            return
        overdue = int((now - self._due) / self._dt)
        self.missed += 1 + overdue
        self.missed_in_a_row += 1 + overdue
        self._due += self._dt * overdue

    def line(self) -> str:
        """Return a line of text about all cycles so far: durations and delays [ms], and the number of missed deadlines."""
        took, late = np.array(self.took or [0.0]), np.percentile(self._late or [0.0], 99)
        named = {"mean": took.mean(), "p50": np.percentile(took, 50), "p99": np.percentile(took, 99), "max": took.max()}
        times = ", ".join(f"{name} {1e3 * value:.2f}" for name, value in named.items())
        return f"{len(self.took)} cycles: {times} ms; begun up to {1e3 * late:.2f} ms late (p99); {self.missed} missed"


class StatusMessages:
    """Printer of status lines in its own thread, so that a slow, closed or held (Ctrl-S) terminal cannot delay the robot."""

    def __init__(self, say: Callable[[str], object] | None = None) -> None:
        """Start the thread; `say` prints a line, by default to standard output."""
        self._say = say or (lambda line: print(line, flush=True))
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="status_messages", daemon=True)
        self._thread.start()

    def __call__(self, line: str) -> None:
        """Queue a line for printing."""
        self._lines.put(line)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            with suppress(OSError, ValueError):  # the terminal may be closed
                self._say(line)

    def close(self) -> None:
        """Wait until all lines are printed, but at most `END_S`."""
        self._lines.put(None)
        self._thread.join(END_S)
