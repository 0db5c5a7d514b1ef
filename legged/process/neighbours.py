"""Trainings that share a device: each holds a lock where the others see it, so that whoever reads its times knows of them."""

import contextlib
import fcntl
import os
import tempfile
import time
from pathlib import Path
from typing import IO

FOLDER = "legged-trainings"
"""Folder in the machine's one for temporary files: in it one for each device, in that a file for each training."""
ENDING = ".training"
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
        descriptor, name = tempfile.mkstemp(prefix=f"{os.getpid()}.", dir=self._folder)
        self._lock = os.fdopen(descriptor, "wb")
        os.fchmod(descriptor, 0o644)
        _locked(self._lock, fcntl.LOCK_EX)
        self._path = Path(name).rename(f"{name}{ENDING}")  # locked before anybody takes it for one of a dead process

    def glance(self) -> None:
        """Look, unless that was done a moment ago."""
        if time.monotonic() - self._looked_s >= PAUSE_S:
            self.look()

    def look(self) -> None:
        """Count the others, and remove what trainings that were killed have left."""
        self._looked_s = time.monotonic()
        others = 0
        for path in self._folder.glob(f"*{ENDING}"):
            if path == self._path:
                continue
            with contextlib.suppress(OSError), path.open("rb") as file:
                if _locked(file, fcntl.LOCK_SH):  # shared: who looks at the same time is not taken for its owner
                    path.unlink()
                else:
                    others += 1
        self.most = max(self.most, others)


def _locked(file: IO[bytes], kind: int) -> bool:
    """Whether a lock of that kind on `file` is ours now. Does not wait."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
