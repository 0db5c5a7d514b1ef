"""Where the files beside the code lie: in a clone at the top level, in an installed wheel inside the package; and how files
are written: whole or not at all.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def data_folder(name: str) -> Path:
    """The folder `name` ('cfg' or 'resources') of this installation.

    Raises:
        FileNotFoundError: the installation lacks it.
    """
    package = Path(__file__).resolve().parent
    for folder in (package / name, package.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"legged: the folder '{name}' is missing beside {package}; install the package again")


def relative(path: Path) -> str:
    """`path` as it is shortest to read: below the working directory if it lies there."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def exists(path: Path) -> bool:
    """Whether there is a file or folder; there is none under a name that no system takes."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside `path` to write to, with the same ending; it takes the place of `path` if nothing fails, else it goes."""
    part = path.with_name(f".{path.name}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
