"""A pool of processes that run side by side, with a limit for each kind of work."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from legged.process.paths import make_folder
from legged.process.processes import child_environment
from legged.process.startup import STAGES_FILE

POLL_S = 0.05
PATIENCE_S = 10.0
"""Time that a process has to end after a signal [s]."""
BUILT = "step captured"
"""Last stage of a training's start-up that keeps the cores busy."""


class Kind(Enum):
    """Resource that a process needs."""

    TRAINING = "training"
    ON_GPU = "evaluation on the GPU"
    ON_CORES = "evaluation on the cores"


@dataclass(eq=False)
class Job:
    """A process that the pool will run."""

    kind: Kind
    command: list[str]
    output: Path
    """File for the process's standard output and errors."""
    done: Callable[["Job", int], Iterable["Job"]]
    """Function that is called with the job and its exit code, and returns the jobs that follow."""
    told: bool = False
    """True after the pool has asked the process to end."""
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def stages(self) -> Path:
        """File that lists the finished stages of its start-up."""
        return self.output.with_suffix(".stages")

    @property
    def starting(self) -> bool:
        """True while the process imports modules and builds its task."""
        return not (self.stages.is_file() and BUILT in self.stages.read_text(encoding="utf-8"))

    def start(self) -> None:
        """Start the process in its own process group, so that Ctrl-C reaches it only through the pool."""
        make_folder(self.output.parent)
        self.stages.unlink(missing_ok=True)
        environment = child_environment() | {STAGES_FILE: str(self.stages)}
        with self.output.open("wb") as output:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )


class WorkerPool:
    """Pool that runs jobs until the queue is empty. A job that fails does not end the others.

    Trainings start in the order of the queue. Each starts when the previous training has built its task, so that start-up
    overlaps with training and no kernel is compiled twice. Jobs of a kind in `shared` wait until every training has ended.
    """

    def __init__(self, room: dict[Kind, int], shared: tuple[Kind, ...]) -> None:
        """Take the number of jobs of each kind that run at once, and the kinds that wait for all trainings."""
        self.room, self.shared = room, shared
        self.waiting: list[Job] = []
        self.running: list[Job] = []
        self.stopped = False

    def run(self, jobs: Iterable[Job]) -> None:
        """Run jobs and the jobs that follow from them. After `stop`, wait for running jobs only."""
        self.waiting += jobs
        try:
            while self.running or (self.waiting and not self.stopped):
                for job in [] if self.stopped else [*self.waiting]:
                    if self._may_start(job):
                        self.waiting.remove(job)
                        job.start()
                        self.running.append(job)
                time.sleep(POLL_S)
                for job in self.running if self.stopped else []:
                    if not job.told:
                        job.told = True
                        _tell(job, signal.SIGTERM)
                for job in [*self.running]:
                    code = job.process.poll() if job.process else None
                    if code is not None:
                        self.running.remove(job)
                        job.stages.unlink(missing_ok=True)
                        self.waiting += job.done(job, code)
        finally:
            self._end_at_once()

    def stop(self) -> None:
        """Start no more jobs and ask the running ones to end. A signal handler may call this."""
        self.stopped = True

    def _may_start(self, job: Job) -> bool:
        same = [other for other in self.running if other.kind is job.kind]
        if len(same) >= self.room[job.kind]:
            return False
        if job.kind is Kind.TRAINING:
            return not any(other.starting for other in same)
        trainings = any(other.kind is Kind.TRAINING for other in (*self.running, *self.waiting))
        return not (job.kind in self.shared and trainings)

    def _end_at_once(self) -> None:
        """End all running jobs before this process ends."""
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGKILL):
            for job in self.running:
                _tell(job, number)
            until = time.monotonic() + PATIENCE_S
            while any(job.process and job.process.poll() is None for job in self.running) and time.monotonic() < until:
                time.sleep(POLL_S)
        self.running.clear()


def _tell(job: Job, number: int) -> None:
    """Send a signal to a job and to its child processes."""
    if job.process is not None and job.process.poll() is None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(job.process.pid, number)


def why_failed(job: Job, code: int) -> str:
    """Return one line on why a job failed: its own error message, else its signal or exit code."""
    try:
        lines = [line for line in job.output.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    except OSError:
        lines = []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    if errors:
        return errors[-1]
    if code < 0:
        named = {number.value: number.name for number in signal.Signals}
        return f"killed by {named.get(-code, f'signal {-code}')}" + (", maybe out of memory" if code == -9 else "")
    return lines[-1].strip() if lines else f"exit code {code}"
