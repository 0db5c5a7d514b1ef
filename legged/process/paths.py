"""Paths of the data folders, which are at the top of a clone or inside an installed package. Functions that write files
atomically, and that check in advance if a folder can be written.
"""

import errno
import fnmatch
import itertools
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from legged.errors import ConfigError, RunError

DISK_FULL = "no space left on the disk"
ABANDONED_S = 3600.0
"""Age at which an unfinished file counts as left over from a killed process [s]."""
LONGEST_NAME = 255
"""Longest name of a file or folder on common file systems [bytes]."""
NO_FOLDER = (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)
"""Errors of the system for names that are not those of folders."""
_REASONS = {errno.ENOSPC: DISK_FULL, errno.EDQUOT: f"{DISK_FULL} (the quota is used up)"}
_COUNTER = itertools.count()


def data_folder(name: str) -> Path:
    """Return the folder `name` ('cfg' or 'resources') of this installation.

    Raises:
        FileNotFoundError: the installation lacks it.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / name, package.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"legged: the folder '{name}' is missing next to {package}; install the package again")


def relative(path: Path) -> str:
    """Return `path` relative to the working directory if it is inside that directory, else unchanged."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (OSError, ValueError):
        return str(path)


def exists(path: Path) -> bool:
    """Return True if the file or folder exists. Return False for names that the system rejects."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def listed(folder: Path, pattern: str = "*") -> list[Path]:
    """Return the entries of a folder whose names match a pattern; none if there is no such folder.

    Raises:
        RunError: the folder can't be read. Path.glob would return nothing.
    """
    try:
        return [folder / name for name in fnmatch.filter(os.listdir(folder), pattern)]
    except ValueError:
        return []
    except OSError as error:
        if error.errno in NO_FOLDER:
            return []
        raise RunError(f"{relative(folder)}: the folder can't be read: {reason(error)}") from error


def reason(error: OSError) -> str:
    """Return why a file operation failed, in a few words."""
    return _REASONS.get(error.errno or 0) or error.strerror or str(error) or type(error).__name__


def full_disk_in(error: BaseException) -> OSError | None:
    """Return the error that reports a full disk: `error` or one of its causes. Return None if there is no such error. A
    library may raise an error of its own because of a full disk.
    """
    found: BaseException | None = error
    while found is not None:
        if isinstance(found, OSError) and found.errno in _REASONS:
            return found
        found = found.__cause__ or found.__context__
    return None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Provide a temporary file next to `path`, with the same ending and a name unique to this process. After the block the
    file replaces `path`, or is removed if the block fails.

    Raises:
        RunError: the file can't be written: the disk is full or read-only, or the folder belongs to another user.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}-{next(_COUNTER)}{path.suffix}")
    try:
        _remove_abandoned(path)
        yield part
        part.replace(path)
    except OSError as error:
        raise RunError(f"{relative(path)}: {reason(error)}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _remove_abandoned(path: Path) -> None:
    """Remove old temporary files for `path`. They are left over from killed processes."""
    temporary = re.compile(rf"\.{re.escape(path.stem)}\.\d+-\d+{re.escape(path.suffix)}")
    for other in path.parent.iterdir():
        with suppress(OSError):
            if temporary.fullmatch(other.name) and time.time() - other.stat().st_mtime > ABANDONED_S:
                other.unlink()


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write a file atomically. Raises the errors of `replacing`."""
    with replacing(path) as part:
        part.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8 atomically. Raises the errors of `replacing`."""
    write_bytes(path, text.encode("utf-8"))


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents.

    Raises:
        ConfigError: `folder` or one of its parents is a file, or the name is not a valid folder name.
        RunError: the folder can't be made: the disk is full or read-only, or the parent belongs to another user.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise not_made(folder, error) from error


def not_made(folder: Path, error: OSError | ValueError) -> ConfigError | RunError:
    """Return the error for a folder that could not be made. A wrong name is the user's mistake (ConfigError), a full disk is
    not (RunError).
    """
    try:
        blocking = next((str(p) for p in (folder, *folder.parents) if os.path.lexists(p) and not p.is_dir()), None)
    except (OSError, ValueError):
        blocking = None
    if blocking is not None:
        return ConfigError(f"{folder}: cannot make the folder: {blocking} is a file")
    if isinstance(error, ValueError) or error.errno in (errno.ENAMETOOLONG, errno.EINVAL, errno.ELOOP):
        return ConfigError(f"{folder}: cannot make the folder ({error})")
    return RunError(f"{folder}: cannot make the folder: {reason(error)}")


def ready_to_write(folder: Path, megabytes: float = 1.0) -> None:
    """Check before long work that its results can be written: that `folder` exists or can be made, that it is writable, and
    that its disk has `megabytes` free. Nothing is left behind.

    Raises:
        ConfigError: `folder` or one of its parents is a file, or the name is not a valid folder name.
        RunError: the folder can't be written: the disk is full or read-only, or the folder belongs to another user.
    """
    if any("\0" in part or len(os.fsencode(part)) > LONGEST_NAME for part in folder.parts):
        raise not_made(folder, OSError(errno.ENAMETOOLONG, "no folder can have such a name"))
    here = next(parent for parent in (folder, *folder.absolute().parents) if os.path.lexists(parent))
    if not here.is_dir():
        raise not_made(folder, NotADirectoryError(errno.ENOTDIR, "not a folder"))
    try:
        with tempfile.TemporaryFile(dir=here, buffering=0) as probe:
            if shutil.disk_usage(here).free < megabytes * 2**20:
                raise OSError(errno.ENOSPC, DISK_FULL)
            probe.write(bytes(2**16))  # a disk quota refuses only an actual write
    except OSError as error:
        raise RunError(f"{relative(folder)}: cannot write there: {reason(error)}") from error
