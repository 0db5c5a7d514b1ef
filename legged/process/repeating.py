"""Repeated call of a function in a thread while other code runs."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeating(call: Callable[[], None], every_s: float, at_end: bool = False) -> Iterator[None]:
    """Call a function every `every_s` seconds while the block runs, and once more after it if `at_end`. The block ends when
    the last call has returned.
    """
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(every_s):
            call()
        if at_end:
            call()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
