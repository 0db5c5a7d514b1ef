"""Trainings that share a device: each holds a lock that the others see, so that its times can say how many there were."""

import contextlib
import os
import tempfile
import time
from pathlib import Path
from typing import IO

from filelock import lock_descriptor

FOLDER = "legged-trainings"
"""Folder in the machine's one for temporary files: in it one for each device, in that a file for each training."""
ENDING = ".training"
TURN = "looking"
"""File that a process locks while it looks: the locks that it tries then would be taken for those of trainings."""
PAUSE_S = 1.0
"""How much time lies between two looks during a training [s]."""


class Neighbours:
    """The other trainings on one device, of any user and started in any way; a context in which this one is among them.

    A lock ends with the process that holds it, however that ends. Trainings of another machine, or of a container with
    temporary files of its own, are not seen.
    """

    def __init__(self, device: str) -> None:
        """`device` is its name among all of the machine's, whatever numbers processes give them: such as a GPU's UUID."""
        self.most = 0
        """The most others that were seen at one time."""
        self._folder = Path(tempfile.gettempdir()) / FOLDER / device
        self._path: Path | None = None
        self._lock: IO[bytes] | None = None
        self._looked_s = 0.0

    def __enter__(self) -> "Neighbours":
        with contextlib.suppress(OSError):  # where nobody may write, others do not see this one
            self._join()
        self.look()
        return self

    def __exit__(self, *_: object) -> None:
        if self._path is not None and self._lock is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            self._lock.close()

    def _join(self) -> None:
        for folder in (self._folder.parent, self._folder):
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                folder.chmod(0o1777)  # for every user, as the folder around it is
        if not (self._folder / TURN).exists():
            (self._folder / TURN).touch(0o644)
        descriptor, name = tempfile.mkstemp(prefix=f"{os.getpid()}.", dir=self._folder)
        self._lock = os.fdopen(descriptor, "wb")
        os.chmod(name, 0o644)
        lock_descriptor(descriptor, blocking=False)
        self._path = Path(name).rename(f"{name}{ENDING}")  # locked before another process looks at it

    def glance(self) -> None:
        """Look, unless that was done a moment ago."""
        if time.monotonic() - self._looked_s >= PAUSE_S:
            self.look()

    def look(self) -> None:
        """Count the others, and remove what trainings that were killed have left; not while another process does so."""
        self._looked_s = time.monotonic()
        with contextlib.suppress(OSError), (self._folder / TURN).open("rb") as turn:
            if lock_descriptor(turn.fileno(), blocking=False):
                self.most = max(self.most, sum(map(_is_of_a_training, self._others())))

    def _others(self) -> list[Path]:
        return [path for path in self._folder.glob(f"*{ENDING}") if path != self._path]


def _is_of_a_training(path: Path) -> bool:
    """Return whether a process holds a file's lock; remove the file if no process does."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        if not lock_descriptor(file.fileno(), blocking=False):
            return True
        path.unlink()
    return False
