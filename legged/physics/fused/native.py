"""Native sources of launches: constants, what all share, and the file of one of them."""

from collections.abc import Iterable, Mapping
from pathlib import Path

SOURCES = Path(__file__).parent
LANES = 32
"""Threads that compute one world on a GPU; on the CPU it is one."""
SHARED_BYTES = 48 * 1024
"""Memory that a block of threads may share."""


def native_source(files: Iterable[str], constants: Mapping[str, int | bool]) -> str:
    """Return the body of a native function: `files` of this folder, one after the other, after lanes.h and `constants`."""
    prelude = "".join(
        f"constexpr {'bool' if isinstance(value, bool) else 'int'} {name} = {int(value)};\n"
        for name, value in constants.items()
    )
    return prelude + "".join((SOURCES / name).read_text() for name in ("lanes.h", *files))
