"""What is done again and again in a thread of its own while something else is at work."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def repeating(call: Callable[[], None], every_s: float, at_end: bool = False) -> Iterator[None]:
    """Call a function every so many seconds while the block runs, and where `at_end` says so once more behind it. The block
    is left when the last call has returned.
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
