"""Imported before anything heavy: imports are most of a start."""

import atexit
import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager

STARTED_S = time.perf_counter()
"""When this package was first imported, on the clock of `time.perf_counter` [s]."""


@contextmanager
def importing() -> Iterator[None]:
    """Imports without garbage collection: they make a million objects that stay, and looking through them time and again
    takes a quarter of a start.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def is_a_command() -> None:
    """This process is one of our commands: what it has imported is never garbage, nor is anything when it ends."""
    gc.freeze()
    atexit.register(gc.freeze)
