"""Which policy is on show: a run folder, of which the newest checkpoint counts, or the best, also while it is trained."""

import time
from dataclasses import dataclass
from pathlib import Path

from legged.config import TaskConfig
from legged.learning.run_folder import BEST, BEST_MODEL, checkpoints, find_checkpoint, newest_run, run_config, run_named

NEWEST = "newest"
"""The checkpoint that is followed, unless it is the BEST, which a training keeps where it evaluates its policy."""


@dataclass(frozen=True)
class Watched:
    """A run, or a policy that comes with this package."""

    cfg: TaskConfig
    folder: Path
    checkpoint: int | None = None
    """The iteration that is shown whatever comes after it; none to follow the training."""
    choice: str = NEWEST
    """Which checkpoint of the training is followed at first: NEWEST or BEST."""


def find_watched(name: str | None, checkpoint: int | str | None) -> Watched:
    """Return the run that `name` names as POLICY; without a name the newest run of all. The run may be so young that it has
    no checkpoint yet. `checkpoint` is an iteration, BEST, or None for the newest.

    Raises:
        ConfigError: there is no such run, or it has no such checkpoint.
    """
    folder = newest_run("POLICY") if name is None else run_named(name, "POLICY", begun=True)
    cfg = run_config(folder)
    if checkpoint in (None, -1):
        return Watched(cfg, folder)
    find_checkpoint(folder, checkpoint)
    return Watched(cfg, folder, choice=BEST) if checkpoint == BEST else Watched(cfg, folder, int(checkpoint or 0))


class CheckpointFollower:
    """Looks into a run folder for the checkpoint to be shown, and says when it is another one."""

    def __init__(self, watched: Watched) -> None:
        """Follow the checkpoint that is asked for; nothing has been shown yet."""
        self.watched = watched
        self.choice = watched.choice
        """NEWEST or BEST; of no account where one checkpoint was asked for."""
        self._shown: tuple[Path, int, int] | None = None

    @property
    def has_best(self) -> bool:
        """Whether there is a best checkpoint to choose."""
        return self.watched.checkpoint is None and (self.watched.folder / BEST_MODEL).is_file()

    def wanted(self) -> Path | None:
        """Return the checkpoint that is to be shown now; None as long as there is none."""
        found = checkpoints(self.watched.folder)
        if self.watched.checkpoint is not None:
            return found.get(self.watched.checkpoint)
        if self.choice == BEST and self.has_best:
            return self.watched.folder / BEST_MODEL
        return found[max(found)] if found else None

    def changed(self) -> Path | None:
        """Return the checkpoint to be shown if it is another file than at the last call, or was written anew."""
        path = self.wanted()
        if path is None:
            return None
        try:
            stat = path.stat()
        except OSError:  # a newer one has taken its place
            return None
        mark = (path, stat.st_mtime_ns, stat.st_size)
        if mark == self._shown:
            return None
        self._shown = mark
        return path

    def forget(self) -> None:
        """Let the next call of `changed` return the checkpoint again, for a task that was built anew."""
        self._shown = None


def age(path: Path) -> float | None:
    """Return how long ago a file was written [s]; None if it has been removed."""
    try:
        return max(0.0, time.time() - path.stat().st_mtime)
    except OSError:
        return None
