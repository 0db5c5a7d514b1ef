"""Native sources of kernels, put together from constants, a shared file, and a kernel's own files."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

SOURCES = Path(__file__).parent
LANES = 32
"""Number of threads per world on a GPU. On a CPU there is one thread."""
SHARED_BYTES = 48 * 1024
"""Shared memory available to a block of threads [bytes]."""
Constant = int | bool | tuple[int, ...]
"""Type of a source's constants: a number, a flag, or a table."""


def lanes_of(device: Any) -> int:
    """Return the number of threads per world on a Warp device."""
    return 1 if device.is_cpu else LANES


def native_source(files: Iterable[str], constants: Mapping[str, Constant]) -> str:
    """Return the body of a native function: `constants`, then lanes.h, then the `files` of this folder in order."""
    prelude = "".join(_defined(name, value) for name, value in constants.items())
    return prelude + "".join((SOURCES / name).read_text() for name in ("lanes.h", *files))


def _defined(name: str, value: Constant) -> str:
    if isinstance(value, tuple):
        return f"static constexpr int {name}[] = {{{', '.join(map(str, value))}}};\n"
    return f"constexpr {'bool' if isinstance(value, bool) else 'int'} {name} = {int(value)};\n"
