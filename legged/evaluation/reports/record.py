"""What a run folder holds, read for a report: whatever is damaged or missing is left out and named, and fails nothing."""

import os
import re
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from legged.config import to_dict
from legged.config.dotted import value_at
from legged.errors import ConfigError
from legged.evaluation.learning_curves import Scalars, read_config, read_scalars
from legged.evaluation.result_file import file_name, read_results
from legged.learning.invocation import Invocation, read_invocation
from legged.learning.run_folder import CODE_FILE, CONFIG_FILE, NOTE_FILE, checkpoints, of_another_policy, run_config
from legged.learning.timing import Timing, read_timing

STAMP = re.compile(r"(\d{4}-\d{2}-\d{2}_\d{2}-\d{2}-\d{2})(?:_(.*))?")
FILMS = ("film.gif", "play.gif", "play.mp4")
"""Files that show the policy, the first that is there."""
QUIET_S = 3600.0
"""A training that has written nothing for so long is taken for ended, whatever has its process's number now [s]."""


@dataclass(frozen=True)
class Code:
    """The state of the code that a run was made with."""

    version: str = ""
    commit: str = ""
    """Full hash; empty where it is not known."""
    files: int = 0
    """Files that differ from the commit."""
    added: int = 0
    removed: int = 0
    text: str = ""
    """All that was written about it."""

    @property
    def summary(self) -> str:
        """The commit in few letters, and how much differs from it."""
        if not self.commit:
            return "not known"
        changed = f", {self.files} file{'s' * (self.files > 1)} changed, +{self.added} -{self.removed}" if self.files else ""
        return self.commit[:10] + changed


@dataclass(frozen=True)
class Record:
    """A run, as far as its folder tells."""

    folder: Path
    config: dict[str, Any]
    """The resolved configuration, by this version's names where it can still be read."""
    began: datetime
    timing: Timing | None
    scalars: Scalars
    results: tuple[dict[str, Any], ...]
    """Evaluations, one an engine."""
    code: Code
    note: str
    """What somebody wrote about it."""
    status: str
    """finished, running, interrupted, crashed or killed."""
    why: str
    """What the status means here."""
    done: int
    """Iterations behind its last policy or log, those before it was resumed too."""
    problems: tuple[str, ...]
    """What could not be read."""
    given: Invocation | None = None
    """What its command line said; None of runs that do not say so."""

    def at(self, path: str) -> Any:
        """Return a setting by its dotted path; None where there is none."""
        return value_at(self.config, path)

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.config.get("task") or self.folder.parent.name)

    @property
    def name(self) -> str:
        """Name of the folder, below that of its experiment."""
        folder = self.folder.resolve()
        return f"{folder.parent.name}/{folder.name}"

    @property
    def run_name(self) -> str:
        """Its own name, if it was given one."""
        return str(self.at("train.runner.run_name") or "")

    @property
    def robots(self) -> int | None:
        """Robots of all processes."""
        found = self.timing.robots if self.timing else self.at("env.num_envs")
        return found if isinstance(found, int) else None

    @property
    def steps_per_iteration(self) -> int | None:
        """Control steps of all robots in an iteration."""
        steps = self.at("train.runner.num_steps_per_env")
        return steps * self.robots if isinstance(steps, int) and self.robots else None

    @property
    def dt(self) -> float | None:
        """Length of a control step [s]."""
        dt, decimation = self.at("sim.dt"), self.at("control.decimation")
        return dt * decimation if isinstance(dt, int | float) and isinstance(decimation, int) else None

    def another_policy(self, result: dict[str, Any] | None) -> str:
        """Return the checkpoint that an evaluation is of; nothing where it is the last one, whose the other figures are."""
        checkpoint = (result or {}).get("checkpoint")
        return str(checkpoint) if of_another_policy(self.folder, checkpoint) else ""

    @property
    def film(self) -> Path | None:
        """A film of its policy, if there is one."""
        return next((path for name in FILMS if (path := self.folder / name).is_file()), None)


def read_record(folder: Path) -> Record:
    """Read a run folder.

    Raises:
        ConfigError: it is none.
    """
    if not (folder / CONFIG_FILE).is_file():
        raise ConfigError(f"{folder}: is no run folder (it has no {CONFIG_FILE})")
    problems: list[str] = []
    config = read_config(folder)
    timing, scalars, given = None, {}, None
    with _noting(problems):
        config = to_dict(run_config(folder))
    with _noting(problems):
        timing = read_timing(folder)
    with _noting(problems):
        given = read_invocation(folder)
    if any(folder.glob("events.out.tfevents.*")):
        with _noting(problems):
            scalars = read_scalars(folder)
    results: list[dict[str, Any]] = []
    for path in sorted(folder.glob(file_name("*"))):
        with _noting(problems):
            results += read_results([path])
    logged = [int(steps[-1]) + 1 for tag, (steps, _) in scalars.items() if not tag.endswith("/time") and len(steps)]
    saved = [number + 1 for number, path in checkpoints(folder).items() if path.name != "model.pt"]
    done = max([*logged, *saved], default=timing.iterations if timing else 0)
    status, why = _status(folder, timing, value_at(config, "train.runner.max_iterations"), done, max(saved, default=0))
    return Record(
        folder, config, _began(folder), timing, scalars, tuple(results), read_code(folder), read_note(folder),
        status, why, done, tuple(problems), given,
    )  # fmt: skip


class _noting(suppress):  # noqa: N801  (a context, as its base)
    """Leave out what can't be read, and note why in a list."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__(ConfigError, OSError, ValueError)
        self._problems = problems

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> bool:
        left_out = bool(super().__exit__(kind, error, trace))
        if left_out:
            self._problems.append(" ".join(str(error).split()))
        return left_out


def _began(folder: Path) -> datetime:
    """Return when a run began, by the name of its folder, else by its configuration's file."""
    match = STAMP.match(folder.resolve().name)
    with suppress(ValueError):
        if match:
            return datetime.strptime(match[1], "%Y-%m-%d_%H-%M-%S")
    return datetime.fromtimestamp((folder / CONFIG_FILE).stat().st_mtime)


def _status(folder: Path, timing: Timing | None, until: Any, done: int, saved: int) -> tuple[str, str]:
    """Return how a run ended, and that in words."""
    of = f"{done:,} of {until:,} iterations" if isinstance(until, int) else f"{done:,} iterations"
    if timing is not None:
        if timing.finished:
            return "finished", of
        if timing.error:
            return "crashed", f"after {of}: {timing.error}"
        return "interrupted", f"after {of}, by a signal, by its sweep, or because its output went away"
    if (folder / "model.pt").is_file():
        return "finished", "a policy that comes with this package"
    if isinstance(until, int) and saved >= until:
        return "finished", f"{of}; it says nothing of its times"
    if is_running(folder):
        return "running", f"{of} so far"
    return "killed", f"after {of}: no end was written, so its process was killed or could not write any more"


def is_running(folder: Path) -> bool:
    """Return whether the process that writes a run's log is alive: on this machine by its number, which is in the log's name
    (events.out.tfevents.<time>.<host>.<process>.<file>), on another one by how long ago it wrote.
    """
    for path in folder.glob("events.out.tfevents.*"):
        match = re.fullmatch(r"events\.out\.tfevents\.\d+\.(.*)\.(\d+)\.\d+", path.name)
        if match is None:
            continue
        with suppress(OSError):
            silent_s = time.time() - path.stat().st_mtime
            if match[1] != socket.gethostname():
                if silent_s < 120.0:
                    return True
            elif silent_s < QUIET_S:
                with suppress(PermissionError):  # it is there, and somebody else's
                    os.kill(int(match[2]), 0)  # asks whether it is there
                return True
    return False


def read_code(folder: Path) -> Code:
    """Read what a run says of the code that it was made with."""
    try:
        text = (folder / CODE_FILE).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return Code()
    head, *rest = text.splitlines() or [""]
    commit = next((line.removeprefix("commit ") for line in rest[:1] if line.startswith("commit ")), "")
    lines = [line for line in rest if line[:1] in ("+", "-") and not line.startswith(("+++ ", "--- "))]
    files = sum(line.startswith("diff --git ") for line in rest)
    added = sum(line[0] == "+" for line in lines)
    return Code(head.removeprefix("legged "), commit, files, added, len(lines) - added, text)


def read_note(folder: Path) -> str:
    """Read what somebody wrote about a run, on one line."""
    with suppress(OSError):
        return " ".join((folder / NOTE_FILE).read_text(encoding="utf-8", errors="replace").split())
    return ""
