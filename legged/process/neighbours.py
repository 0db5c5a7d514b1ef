"""Count of the trainings that share a device. The report of a training states this number. Every training holds a file
lock, by which the other trainings notice it.
"""

import contextlib
import os
import tempfile
import time
from pathlib import Path
from typing import IO

from filelock import lock_descriptor

FOLDER = "legged-trainings"
"""Folder in the machine's temporary folder; it has one folder for each device, with one file for each training."""
ENDING = ".training"
TURN = "looking"
"""File that a process locks while it counts. If two counted at once, each could take the other's locks for trainings."""
PAUSE_S = 1.0
"""Shortest time between two counts during a training [s]."""


class Neighbours:
    """Counter of all users' other trainings on a device. Inside its `with` block the others can see this training.

    The system releases a lock when its process ends, even if the process is killed. Trainings of another machine, or of a
    container with separate temporary files, are not seen.
    """

    def __init__(self, device: str) -> None:
        """Create the counter. `device` is a name that is unique on this machine, such as a GPU's UUID. An index is not
        unique, because processes may number the devices differently.
        """
        self.most = 0
        """Largest number of other trainings seen at one time."""
        self._folder = Path(tempfile.gettempdir()) / FOLDER / device
        self._path: Path | None = None
        self._lock: IO[bytes] | None = None
        self._looked_s = 0.0

    def __enter__(self) -> "Neighbours":
        with contextlib.suppress(OSError):  # if the folder can't be written, other trainings do not see this one
            for folder in (self._folder.parent, self._folder):
                with contextlib.suppress(FileExistsError):
                    folder.mkdir()
                    folder.chmod(0o1777)  # writable for every user, like its parent folder
            if not (self._folder / TURN).exists():
                (self._folder / TURN).touch(0o644)
            descriptor, name = tempfile.mkstemp(prefix=f"{os.getpid()}.", dir=self._folder)
            self._lock = os.fdopen(descriptor, "wb")
            os.chmod(name, 0o644)
            lock_descriptor(descriptor, blocking=False)
            # Other trainings delete unlocked files with this ending. So the file is renamed only after it is locked.
            self._path = Path(name).rename(f"{name}{ENDING}")
        self.look()
        return self

    def __exit__(self, *_: object) -> None:
        if self._path is not None and self._lock is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            self._lock.close()

    def glance(self) -> None:
        """Count the other trainings, unless the last count was less than PAUSE_S ago."""
        if time.monotonic() - self._looked_s >= PAUSE_S:
            self.look()

    def look(self) -> None:
        """Count the other trainings, and delete the files of killed trainings. Do nothing while another process counts."""
        self._looked_s = time.monotonic()
        with contextlib.suppress(OSError), (self._folder / TURN).open("rb") as turn:
            if lock_descriptor(turn.fileno(), blocking=False):
                others = {*self._folder.glob(f"*{ENDING}")} - {self._path}
                self.most = max(self.most, sum(map(_is_of_a_training, others)))


def _is_of_a_training(path: Path) -> bool:
    """Return True if a process holds a file's lock; delete the file otherwise."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        if not lock_descriptor(file.fileno(), blocking=False):
            return True
        path.unlink()
    return False
