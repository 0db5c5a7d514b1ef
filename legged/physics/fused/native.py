"""Native sources of launches: constants, what all share, and the file of one of them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

SOURCES = Path(__file__).parent
LANES = 32
"""Threads that compute one world on a GPU; on the CPU it is one."""
SHARED_BYTES = 48 * 1024
"""Memory that a block of threads may share."""
Constant = int | bool | tuple[int, ...]
"""What a source may be told: a number, whether something is so, or a table."""


def lanes_of(device: Any) -> int:
    """Return how many threads share a world's work on a Warp device."""
    return 1 if device.is_cpu else LANES


def native_source(files: Iterable[str], constants: Mapping[str, Constant]) -> str:
    """Return the body of a native function: `files` of this folder, one after the other, after `constants` and lanes.h."""
    prelude = "".join(_defined(name, value) for name, value in constants.items())
    return prelude + "".join((SOURCES / name).read_text() for name in ("lanes.h", *files))


def _defined(name: str, value: Constant) -> str:
    """Return the line that defines a constant, or a table of them."""
    if isinstance(value, tuple):
        return f"static constexpr int {name}[] = {{{', '.join(map(str, value))}}};\n"
    return f"constexpr {'bool' if isinstance(value, bool) else 'int'} {name} = {int(value)};\n"
