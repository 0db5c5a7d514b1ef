"""The watched policy: a run folder, also of a running training, and which of its checkpoints is shown."""

import time
from dataclasses import dataclass
from pathlib import Path

from legged.config import TaskConfig
from legged.learning.run_folder import BEST, BEST_MODEL, checkpoints, find_checkpoint, newest_run, run_config, run_named

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
        """Return the checkpoint to show; None before the first one is written."""
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
    """Return how long ago a file was written [s]; None if it has been removed."""
    try:
        return max(0.0, time.time() - path.stat().st_mtime)
    except OSError:
        return None
