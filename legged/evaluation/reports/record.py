"""The contents of a run folder, read for a report. Parts that cannot be read are left out, and the reasons are kept."""

import os
import re
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from legged.config import to_dict
from legged.config.dotted import MISSING, differences, flat, value_at
from legged.config.yaml_files import dump
from legged.errors import ConfigError
from legged.evaluation.engines import by_engine
from legged.evaluation.learning_curves import Log, Scalars, read_config, read_scalars
from legged.evaluation.result_file import file_name, read_results
from legged.learning.invocation import Invocation, read_invocation
from legged.learning.run_folder import CODE_FILE, CONFIG_FILE, NOTE_FILE, checkpoints, of_another_policy, run_config
from legged.learning.timing import Timing, read_timing
from legged.process.paths import exists, listed
from legged.registry import task_config

FILMS = ("film.gif", "play.gif", "play.mp4")
"""Names of the policy's films; the first film that exists is shown."""
NAMES = ("train.runner.run_name", "train.runner.experiment_name", "train.runner.report", "train.runner.film", "task")
"""Settings that do not affect the policy."""
MOST_WORDS = 4
"""Largest number of settings that a summary names."""
LONGEST_VALUE = 60
DEEPEST = 3
"""Number of levels of folders that are searched for runs: logs/, logs/<task>/ and logs/<task>/<run>/."""
QUIET_S = 3600.0
"""Time without new output after which a training counts as ended [s], even if a process with its process id exists."""
QUIET_ELSEWHERE_S = 120.0
"""Time without new output after which a training on another machine counts as ended [s]."""


@dataclass(frozen=True)
class Code:
    """The code that made a run: version, commit and uncommitted changes."""

    version: str = ""
    commit: str = ""
    """Full hash of the commit; empty if it is not known."""
    files: int = 0
    """Number of files that differ from the commit."""
    added: int = 0
    removed: int = 0
    text: str = ""
    """The whole text of CODE_FILE."""

    @property
    def summary(self) -> str:
        """The commit's short hash, and the number of files and lines that differ from the commit."""
        if not self.commit:
            return "not known"
        changed = f", {self.files} file{'s' * (self.files > 1)} changed, +{self.added} -{self.removed}" if self.files else ""
        return self.commit[:10] + changed


@dataclass(frozen=True)
class Record:
    """Contents of a run's folder."""

    folder: Path
    config: dict[str, Any]
    """The complete configuration with this version's field names, or the file's names if this version can't read the file."""
    began: datetime
    timing: Timing | None
    scalars: Scalars
    results: dict[str, dict[str, Any]]
    """Name of an engine -> the run's evaluation in it, in the order of ENGINES."""
    code: Code
    note: str
    """The user's note on the run (`--note`)."""
    status: str
    """One of finished, running, interrupted, crashed and killed."""
    why: str
    """Details of the status."""
    done: int
    """Number of iterations up to the last checkpoint or log entry. Iterations before the run was resumed are counted too."""
    problems: tuple[str, ...]
    """Reasons why parts could not be read."""
    given: Invocation | None = None
    """Contents of the command line; None for runs that did not store it."""

    def at(self, path: str) -> Any:
        """Return a setting by its dotted path; None if it is absent."""
        return value_at(self.config, path)

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.config.get("task") or self.folder.parent.name)

    @property
    def name(self) -> str:
        """Name of the experiment's folder and of the run's folder: 'anymal_c_flat/2026-01-31_12-00-00'."""
        return "/".join(self.folder.resolve().parts[-2:])

    @property
    def robots(self) -> int | None:
        """Number of robots in all processes."""
        found = self.timing.robots if self.timing else self.at("env.num_envs")
        return found if isinstance(found, int) else None

    @property
    def steps_per_iteration(self) -> int | None:
        """Control steps of all robots in an iteration."""
        steps = self.at("train.runner.num_steps_per_env")
        return steps * self.robots if isinstance(steps, int) and self.robots else None

    @property
    def changes(self) -> dict[str, Any]:
        """Settings on the run's command line; empty if the command line was not stored."""
        return {} if self.given is None else dict(self.given.changes)

    @property
    def log(self) -> Log:
        """Logged values and configuration."""
        return Log(self.scalars, self.config)

    def another_policy(self, result: dict[str, Any] | None) -> str:
        """Return the name of the checkpoint that `result` evaluates, or an empty text if it is the run's last checkpoint."""
        checkpoint = (result or {}).get("checkpoint")
        return str(checkpoint) if of_another_policy(self.folder, checkpoint) else ""


def folders_in(path: Path) -> list[Path]:
    """Return the run folders at or below `path`, at most two levels deep: `path` may be a run folder, logs/<task>/ or logs/.

    Raises:
        ConfigError: there is no run folder.
        RunError: a folder can't be read.
    """
    levels = [[path]]
    for _ in range(DEEPEST - 1):
        levels.append(sorted(inside for folder in levels[-1] for inside in listed(folder)))
    folders = [folder for level in levels for folder in level if exists(folder / CONFIG_FILE)]
    if not folders:
        raise ConfigError(f"{path}: holds no run folder (there is no {CONFIG_FILE} in it)")
    return folders


def read_record(folder: Path) -> Record:
    """Read a run folder.

    Raises:
        ConfigError: the folder is not a run folder.
    """
    if not (folder / CONFIG_FILE).is_file():
        raise ConfigError(f"{folder}: is no run folder (it has no {CONFIG_FILE})")
    problems: list[str] = []

    def known(read: Callable[[Path], Any], path: Path = folder, otherwise: Any = None) -> Any:
        """Return the result of `read`. If `read` fails, add the reason to the problems and return `otherwise`."""
        try:
            return read(path)
        except (ConfigError, OSError, ValueError) as error:
            problems.append(" ".join(str(error).split()))
            return otherwise

    config = known(lambda path: to_dict(run_config(path)), otherwise=read_config(folder))
    timing, given = known(read_timing), known(read_invocation)
    scalars = known(read_scalars, otherwise={}) if any(folder.glob("events.out.tfevents.*")) else {}
    files = sorted(folder.glob(file_name("*")))
    results = by_engine(result for path in files for result in known(lambda one: read_results([one]), path, []))
    logged = [int(steps[-1]) + 1 for tag, (steps, _) in scalars.items() if not tag.endswith("/time") and len(steps)]
    saved = [number + 1 for number, path in checkpoints(folder).items() if path.name != "model.pt"]
    done = max([*logged, *saved], default=timing.iterations if timing else 0)
    status, why = _status(folder, timing, value_at(config, "train.runner.max_iterations"), done, max(saved, default=0))
    return Record(
        folder, config, _began(folder), timing, scalars, results, read_code(folder), read_note(folder),
        status, why, done, tuple(problems), given,
    )  # fmt: skip


def _began(folder: Path) -> datetime:
    """Return the time at which a run began: the time in the folder's name, else the configuration file's last change."""
    with suppress(ValueError):
        return datetime.strptime(folder.resolve().name[:19], "%Y-%m-%d_%H-%M-%S")
    return datetime.fromtimestamp((folder / CONFIG_FILE).stat().st_mtime)


def _status(folder: Path, timing: Timing | None, until: Any, done: int, saved: int) -> tuple[str, str]:
    """Return `status` and `why` of a record."""
    of = f"{done:,} of {until:,} iterations" if isinstance(until, int) else f"{done:,} iterations"
    if timing is not None:
        if timing.finished:
            return "finished", of
        if timing.error:
            return "crashed", f"after {of}: {timing.error}"
        return "interrupted", f"after {of}, by a signal, by its sweep, or because its output was closed"
    if (folder / "model.pt").is_file():
        return "finished", "a policy that comes with this package"
    if isinstance(until, int) and saved >= until:
        return "finished", f"{of}; the run folder holds no times"
    if is_running(folder):
        return "running", f"{of} so far"
    return "killed", f"after {of}: no end was written, so the process was killed or could no longer write"


def is_running(folder: Path) -> bool:
    """Return whether the process that writes a run's log is alive. The log's name holds the host and the id of
    the process (events.out.tfevents.<time>.<host>.<process>.<file>). On this machine a process with this id must exist, and
    the log must have changed within QUIET_S. On another machine the log must have changed within QUIET_ELSEWHERE_S.
    """
    for path in folder.glob("events.out.tfevents.*"):
        match = re.fullmatch(r"events\.out\.tfevents\.\d+\.(.*)\.(\d+)\.\d+", path.name)
        with suppress(OSError):
            here = match is not None and match[1] == socket.gethostname()
            if match is None or time.time() - path.stat().st_mtime >= (QUIET_S if here else QUIET_ELSEWHERE_S):
                continue
            with suppress(PermissionError):  # the process exists and belongs to another user
                if here and match is not None:
                    os.kill(int(match[2]), 0)  # signal 0 only checks that the process exists
            return True
    return False


def read_code(folder: Path) -> Code:
    """Read the version, the commit and the uncommitted changes of the code that made a run."""
    try:
        text = (folder / CODE_FILE).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return Code()
    head, *rest = text.splitlines() or [""]
    commit = rest[0].removeprefix("commit ") if rest and rest[0].startswith("commit ") else ""
    lines = [line for line in rest if line[:1] in ("+", "-") and not line.startswith(("+++ ", "--- "))]
    files = sum(line.startswith("diff --git ") for line in rest)
    added = sum(line[0] == "+" for line in lines)
    return Code(head.removeprefix("legged "), commit, files, added, len(lines) - added, text)


def read_note(folder: Path) -> str:
    """Return the note of a run as one line; an empty text without a note."""
    with suppress(OSError):
        return " ".join((folder / NOTE_FILE).read_text(encoding="utf-8", errors="replace").split())
    return ""


# ---- differences ------------------------------------------------------------------------------------------------------


def from_task_file(record: Record) -> dict[str, list[Any]] | None:
    """Return setting -> [the run's value, the value in the task's files], for settings that differ; None if the run's task is
    unknown. If the run's device is unknown, try the task's settings for CPU and for GPU, and return the shorter result.
    """
    where = [record.timing.device == "cpu"] if record.timing else [False, True]
    try:
        of_task = [to_dict(task_config(record.task, on_cpu=on_cpu)) for on_cpu in where]
    except (ConfigError, OSError):
        return None
    return min((differences([record.config, config]) for config in of_task), key=len)


def words(value: Any) -> str:
    """Return a value as one line of YAML, shortened if it is long; a dash for a missing value."""
    if value is MISSING:
        return "-"
    text = dump(value, default_flow_style=True, width=1_000_000).strip().removesuffix("...").strip()
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 3] + "..."


def what_changed(record: Record, named: bool = True) -> str:
    """Return a summary of a run: its note or, without a note, its name (if `named`) and the settings that differ from those
    of the task. If the task is unknown, the settings are those of the command line.
    """
    if record.note:
        return record.note
    found = from_task_file(record)
    changed = record.changes if found is None else {path: own for path, (own, _) in found.items()}
    said = [
        f"{'.'.join(path.split('.')[-2:])} {words(own)}" for path, own in changed.items() if path not in (*NAMES, "env.seed")
    ]
    if len(said) > MOST_WORDS:
        said = [*said[:MOST_WORDS], f"{len(said) - MOST_WORDS} more settings"]
    name = str(record.at("train.runner.run_name") or "") if named else ""
    return ": ".join(text for text in (name, ", ".join(said)) if text)


def but_for_seeds(record: Record) -> str:
    """Return a text that is the same for two runs if they differ only in their seeds and names."""
    told = {path: value for path, value in flat(record.config).items() if path not in (*NAMES[:-1], "env.seed")}
    device = record.timing.device if record.timing else ""
    return repr((sorted(told.items()), record.note, record.status, record.done, record.code.summary, device))
