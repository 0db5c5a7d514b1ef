"""A fixed rate: when cycles begin, how long they take, and which were late."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

PRIORITY = 20
"""Of a process that must begin its cycles in time, among those that Linux runs first come, first served (1 to 99)."""


def take_priority(priority: int = PRIORITY) -> bool:
    """Ask Linux to run this process before all that are not in a hurry; return whether it may.

    A user needs the right for it: a line `NAME - rtprio 20` in /etc/security/limits.conf.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):  # another system, or no right
        return False
    return True


@dataclass(frozen=True)
class CycleTimes:
    """What the cycles of a run took [s]."""

    count: int
    mean: float
    p50: float
    p99: float
    longest: float
    late_p99: float
    """How late cycles began, of which 1 % were later [s]."""
    missed: int
    """Cycles that did not begin or end in time: a cycle that takes two and a half of them has missed two deadlines."""

    def line(self) -> str:
        """Say it in one line, in milliseconds."""
        times = ", ".join(
            f"{name} {1e3 * value:.2f}"
            for name, value in (("mean", self.mean), ("p50", self.p50), ("p99", self.p99), ("max", self.longest))
        )
        return f"{self.count} cycles: {times} ms; begun up to {1e3 * self.late_p99:.2f} ms late (p99); {self.missed} missed"


class Pace:
    """Cycles that begin every `dt` after a first one, however long each of them takes."""

    def __init__(
        self, dt: float, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], object] = time.sleep
    ) -> None:
        """Begin the first cycle with the first call of `wait`."""
        self._dt, self._clock, self._sleep = dt, clock, sleep
        self._due: float | None = None
        self._began = 0.0
        self.took: list[float] = []
        """From a cycle's begin to its end [s]."""
        self.late: list[float] = []
        """From when a cycle should have begun until it did [s]."""
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
        """End a cycle. One that ends after the next should have begun has missed its deadline, and those of all cycles that
        are overdue by then, which are left out.
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
        """Return what the cycles so far have taken."""
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
