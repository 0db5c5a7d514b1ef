"""Processes side by side: as many of each kind as there is room for."""

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
"""A process that was told to end at once has so long for it [s]."""
BUILT = "step captured"
"""The stage with which the start-up of a training ends, as far as it keeps cores busy."""


class Kind(Enum):
    """What a process needs for itself."""

    TRAINING = "training"
    ON_GPU = "evaluation on the GPU"
    ON_CORES = "evaluation on the cores"


@dataclass(eq=False)
class Job:
    """A process to be run."""

    kind: Kind
    command: list[str]
    output: Path
    """File for what it prints."""
    done: Callable[["Job", int], Iterable["Job"]]
    """Called with its exit code when it has ended; gives the jobs that follow from it."""
    told: bool = False
    """Whether it was asked to end."""
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def stages(self) -> Path:
        """The file that is told when the stages of its start have ended."""
        return self.output.with_suffix(".stages")

    @property
    def starting(self) -> bool:
        """Whether it still imports and builds."""
        return not (self.stages.is_file() and BUILT in self.stages.read_text(encoding="utf-8"))

    def start(self) -> None:
        """Start the process, in a session of its own: Ctrl-C reaches it through us alone."""
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


class Crew:
    """Runs jobs until none is left. One that fails ends nothing but itself.

    Trainings begin in the order in which they come, each as soon as the one before it has been built: so the start-up of one
    falls into the training of another, and the same kernels are not compiled twice. With room for one training, each is
    alone on the device that trains: what else needs that device waits until all have ended.
    """

    def __init__(self, room: dict[Kind, int], shared: tuple[Kind, ...]) -> None:
        """`room` says how many of each kind run at once; `shared` are the kinds that wait until no training is left."""
        self.room, self.shared = room, shared
        self.waiting: list[Job] = []
        self.running: list[Job] = []
        self.stopped = False

    def run(self, jobs: Iterable[Job]) -> None:
        """Run jobs and all that follow from them. After `stop` no other is started, and those that run may end."""
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
        """Start no other job, and ask those that run to end; a training leaves a checkpoint. A signal may call this."""
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
        """End what still runs, because this process has to go."""
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGKILL):
            for job in self.running:
                _tell(job, number)
            until = time.monotonic() + PATIENCE_S
            while any(job.process and job.process.poll() is None for job in self.running) and time.monotonic() < until:
                time.sleep(POLL_S)
        self.running.clear()


def _tell(job: Job, number: int) -> None:
    """Send a signal to a job and to what it has started."""
    if job.process is not None and job.process.poll() is None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(job.process.pid, number)


def why_failed(job: Job, code: int) -> str:
    """Say in a line why a job failed: in its own words, else how it ended."""
    try:
        lines = [line for line in job.output.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    except OSError:
        lines = []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    if errors:
        return errors[-1]
    if code < 0:
        named = {number.value: number.name for number in signal.Signals}
        return f"killed by {named.get(-code, f'signal {-code}')}" + (", maybe for want of memory" if code == -9 else "")
    return lines[-1].strip() if lines else f"exit code {code}"
