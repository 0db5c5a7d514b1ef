"""A fixed cycle rate, with statistics of durations, delays and missed deadlines."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

PRIORITY = 20
"""Real-time priority of the process under Linux's SCHED_FIFO (1 to 99)."""


def take_priority(priority: int = PRIORITY) -> bool:
    """Request a real-time priority from Linux; return whether it was granted.

    It requires a permission: a line `NAME - rtprio 20` in /etc/security/limits.conf.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):  # another system, or no permission
        return False
    return True


@dataclass(frozen=True)
class CycleTimes:
    """Statistics of the cycles of a run [s]."""

    count: int
    mean: float
    p50: float
    p99: float
    longest: float
    late_p99: float
    """99th percentile of the delay with which cycles began [s]."""
    missed: int
    """Missed deadlines; a cycle that takes two and a half periods misses two."""

    def line(self) -> str:
        """Return the statistics as a line of text, in milliseconds."""
        times = ", ".join(
            f"{name} {1e3 * value:.2f}"
            for name, value in (("mean", self.mean), ("p50", self.p50), ("p99", self.p99), ("max", self.longest))
        )
        return f"{self.count} cycles: {times} ms; begun up to {1e3 * self.late_p99:.2f} ms late (p99); {self.missed} missed"


class Pace:
    """A clock of cycles that begin every `dt` after the first one, regardless of their durations."""

    def __init__(
        self, dt: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], object] = time.sleep
    ) -> None:
        """Prepare the clock; the first call of `wait` begins the first cycle."""
        self._dt, self._clock, self._sleep = dt, clock, sleep
        self._due: float | None = None
        self._began = 0.0
        self.took: list[float] = []
        """Duration of each cycle [s]."""
        self.late: list[float] = []
        """Delay of the beginning of each cycle [s]."""
        self.missed = 0
        self.missed_in_a_row = 0

    def wait(self) -> float:
        """Wait until the next cycle is due; return the time at which it begins [s]."""
        now = self._clock()
        if self._due is None:
            self._due = now
        if now < self._due:
            self._sleep(self._due - now)
            now = self._clock()
        self.late.append(max(0.0, now - self._due))
        self._began = now
        return now

    def done(self) -> None:
        """End a cycle. If it ends after the next one was due, it has missed its deadline and those of all overdue cycles,
        which are skipped.
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

    def times(self) -> CycleTimes:
        """Return the statistics of the cycles so far."""
        took = np.array(self.took or [0.0])
        return CycleTimes(
            count=len(self.took),
            mean=float(took.mean()),
            p50=float(np.percentile(took, 50)),
            p99=float(np.percentile(took, 99)),
            longest=float(took.max()),
            late_p99=float(np.percentile(self.late or [0.0], 99)),
            missed=self.missed,
        )
