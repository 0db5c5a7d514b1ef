"""The watched policy: a run folder, also of a running training, and which of its checkpoints is shown."""

import argparse
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from legged.commandline.arguments import overrides
from legged.config import TaskConfig
from legged.errors import ConfigError, suggest
from legged.learning.run_folder import (
    BEST,
    BEST_MODEL,
    CONFIG_FILE,
    LOGS,
    checkpoints,
    experiment_folder,
    find_checkpoint,
    run_config,
    shipped_policy,
)
from legged.process.paths import data_folder, exists, relative
from legged.registry import task_config

NEWEST = "newest"
"""Choice of the newest checkpoint. The alternative, BEST, exists if the training evaluates its policy."""


@dataclass(frozen=True)
class Watched:
    """A run folder or a shipped policy."""

    cfg: TaskConfig
    folder: Path
    checkpoint: int | None = None
    """Iteration that is shown; None follows the training."""
    choice: str = NEWEST
    """Checkpoint that is followed at first: NEWEST or BEST."""


def find_watched(args: argparse.Namespace) -> Watched:
    """Return the policy of --task, --load_run and --checkpoint; by default the newest run, of the task if one is given, or
    else the policy that is shipped for the task. The run may not have a checkpoint yet.

    Raises:
        ConfigError: there is no such run, it has another task, or it has no such checkpoint.
    """
    flags = [(key, value) for key, value in overrides(args) if key == "train.runner.experiment_name"]
    task = None if args.task is None else task_config(args.task, flags)
    experiment = (
        experiment_folder(task) if task is not None else LOGS / args.experiment_name if args.experiment_name else None
    )
    folder = _newest(task, experiment) if args.load_run in (None, "-1") else _named(args.load_run, experiment)
    cfg = run_config(folder)
    if args.task is not None and cfg.task != args.task:
        raise ConfigError(f"--load_run: {relative(folder)} was trained on '{cfg.task}', not on '{args.task}'")
    if args.checkpoint in (None, -1):
        return Watched(cfg, folder)
    find_checkpoint(folder, args.checkpoint)
    return Watched(cfg, folder, choice=BEST) if args.checkpoint == BEST else Watched(cfg, folder, args.checkpoint)


def _newest(task: TaskConfig | None, experiment: Path | None) -> Path:
    """Return the run folder that was created or written to last, or else the shipped policy of the task."""
    where = LOGS.glob("*/*") if experiment is None else experiment.glob("*")
    runs = [folder for folder in where if exists(folder / CONFIG_FILE)]
    if runs:
        return max(runs, key=_last_written)
    shipped = None if task is None else shipped_policy(task.task)
    if shipped is None:
        place = relative(experiment or LOGS)
        instead = (
            "train one first" if task is not None else "train one first, or name a task whose policy is shipped (--task)"
        )
        raise ConfigError(f"--load_run: there is no run in {place}; {instead}")
    return shipped


def _named(name: str, experiment: Path | None) -> Path:
    """Return the run folder of a name: a path, a name in the experiment or in any other, or a shipped policy."""
    shipped = data_folder("resources") / "policies"
    parents = [*([experiment] if experiment is not None else []), Path(), LOGS, shipped.parent.parent, shipped]
    with suppress(OSError, ValueError):  # no name of a folder
        for folder in (parent / name for parent in parents if name.strip()):
            if exists(folder / CONFIG_FILE):
                return folder
        found = [folder for folder in LOGS.glob("*/*") if folder.name == name and exists(folder / CONFIG_FILE)]
        if found:
            return max(found, key=_last_written)
    known = [f"{run.parent.name}/{run.name}" for run in LOGS.glob("*/*") if exists(run / CONFIG_FILE)]
    known += [policy.name for policy in shipped.glob("*") if checkpoints(policy)]
    raise ConfigError(f"--load_run: there is no run '{name}'{suggest(name, known, 'runs')}")


def _last_written(folder: Path) -> float:
    """Return the time at which a run was created or its latest checkpoint written [s since 1970]."""
    return max(_stamps([folder / CONFIG_FILE, *checkpoints(folder).values()]), default=0.0)


def _stamps(paths: Iterable[Path]) -> list[float]:
    found = []
    for path in paths:
        with suppress(OSError):  # removed in between
            found.append(path.stat().st_mtime)
    return found


class CheckpointFollower:
    """Finder of the checkpoint to show in a run folder, which notices when it changes."""

    def __init__(self, watched: Watched) -> None:
        """Follow the checkpoint of `watched`; nothing has been shown yet."""
        self.watched = watched
        self.choice = watched.choice
        """NEWEST or BEST; without effect if `watched` names a checkpoint."""
        self._shown: tuple[Path, int, int] | None = None

    @property
    def has_best(self) -> bool:
        """Return whether BEST can be chosen."""
        return self.watched.checkpoint is None and (self.watched.folder / BEST_MODEL).is_file()

    def wanted(self) -> Path | None:
        """Return the checkpoint to show; None if there is none yet."""
        found = checkpoints(self.watched.folder)
        if self.watched.checkpoint is not None:
            return found.get(self.watched.checkpoint)
        if self.choice == BEST and self.has_best:
            return self.watched.folder / BEST_MODEL
        return found[max(found)] if found else None

    def changed(self) -> Path | None:
        """Return the checkpoint to show if it is another file than at the last call or was rewritten, else None."""
        path = self.wanted()
        if path is None:
            return None
        try:
            stat = path.stat()
        except OSError:  # replaced by a newer one
            return None
        mark = (path, stat.st_mtime_ns, stat.st_size)
        if mark == self._shown:
            return None
        self._shown = mark
        return path

    def forget(self) -> None:
        """Make the next call of `changed` return the checkpoint again, for a new task."""
        self._shown = None


def age(path: Path) -> float | None:
    """Return the age of a file [s]; None if it does not exist."""
    stamps = _stamps([path])
    return max(0.0, time.time() - stamps[0]) if stamps else None
