"""Child processes: their environment, and a pool that runs several of them in parallel."""

import os
import signal
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import DEVNULL, STDOUT, Popen

from legged.process.paths import make_folder
from legged.process.startup import STAGES_FILE

OF_THIS_PROCESS = (STAGES_FILE, "RANK", "LOCAL_RANK", "WORLD_SIZE")
"""Environment variables that children do not get: the file of start-up stages, and a training's ranks on several GPUs."""
INSTALLED = ("site-packages", "dist-packages")
"""Names of folders with installed packages."""
POLL_S = 0.05
PATIENCE_S = 10.0
"""Time in which a process must end after a signal [s]."""
BUILT = "step captured"
"""Name of the start-up stage after which a training no longer keeps the cores busy."""


def child_environment() -> dict[str, str]:
    """Return the environment for a child process in Python, so that the child imports this copy of the package. The
    variables in OF_THIS_PROCESS are left out.
    """
    environment = {name: value for name, value in os.environ.items() if name not in OF_THIS_PROCESS}
    top = Path(__file__).resolve().parents[2]
    if top.name not in INSTALLED:
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(top), os.environ.get("PYTHONPATH"))))
    return environment


def start_apart(command: list[str], output: Path, **variables: str) -> Popen[bytes]:
    """Start a process in its own process group, so that Ctrl-C does not reach it. Add `variables` to its environment, and
    write its output and errors to the file `output`.

    Raises:
        OSError: the process can't be started, or the file can't be written.
    """
    environment = child_environment() | variables
    with output.open("wb") as file:
        return Popen(command, stdin=DEVNULL, stdout=file, stderr=STDOUT, env=environment, start_new_session=True)


@dataclass(eq=False)
class Job:
    """A process that the pool will run."""

    command: list[str]
    output: Path
    """File for the process's standard output and errors."""
    done: Callable[["Job", int], Iterable["Job"]]
    """Function that is called with the job and its exit code, and returns the jobs that follow."""
    told: bool = False
    """True after the pool has asked the process to end."""
    process: Popen[bytes] | None = field(default=None, repr=False)

    @property
    def stages(self) -> Path:
        """File that lists the finished stages of the process's start-up."""
        return self.output.with_suffix(".stages")

    @property
    def starting(self) -> bool:
        """True while the process imports modules and builds its task."""
        return not (self.stages.is_file() and BUILT in self.stages.read_text(encoding="utf-8"))

    def start(self) -> None:
        """Start the process; Ctrl-C reaches it only through the pool."""
        make_folder(self.output.parent)
        self.stages.unlink(missing_ok=True)
        self.process = start_apart(self.command, self.output, **{STAGES_FILE: str(self.stages)})

    def tell(self, number: int) -> None:
        """Send a signal to the process and to its child processes."""
        if self.process is not None and self.process.poll() is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, number)


class WorkerPool:
    """Pool that runs jobs until the queue is empty. A job that fails does not end the others.

    Jobs are trainings. They start in the order of the queue, each when the previous training has built its task, so that
    start-up overlaps with training and no kernel is compiled twice.
    """

    def __init__(self, room: int) -> None:
        """Build a pool. `room` is the largest number of running jobs."""
        self.room = room
        self.waiting: list[Job] = []
        self.running: list[Job] = []
        self.stopped = False

    def run(self, jobs: Iterable[Job]) -> None:
        """Run jobs and the jobs that follow from them. After `stop`, wait for running jobs only."""
        self.waiting += jobs
        try:
            while self.running or (self.waiting and not self.stopped):
                has_room = len(self.running) < self.room and not any(job.starting for job in self.running)
                if self.waiting and has_room and not self.stopped:
                    job = self.waiting.pop(0)
                    job.start()
                    self.running.append(job)
                time.sleep(POLL_S)
                for job in [*self.running]:
                    if self.stopped and not job.told:
                        job.told = True
                        job.tell(signal.SIGTERM)
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

    def _end_at_once(self) -> None:
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGKILL):
            for job in self.running:
                job.tell(number)
            until = time.monotonic() + PATIENCE_S
            while any(job.process and job.process.poll() is None for job in self.running) and time.monotonic() < until:
                time.sleep(POLL_S)
        self.running.clear()


def why_failed(job: Job, code: int) -> str:
    """Return one line on why a job failed: its error message, the signal that killed it, its last output or its exit code."""
    text = job.output.read_text(encoding="utf-8", errors="replace") if job.output.is_file() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    if errors:
        return errors[-1].removeprefix("error: ")
    if code < 0:
        named = {number.value: number.name for number in signal.Signals}
        return f"killed by {named.get(-code, f'signal {-code}')}" + (", maybe out of memory" if code == -9 else "")
    return lines[-1] if lines else f"exit code {code}"
