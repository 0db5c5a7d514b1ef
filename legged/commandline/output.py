"""Standard output that may be lost: a closed pipe, a full disk, a closed terminal. The command goes on without it."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from legged.process.paths import DISK_FULL, reason


class Output:
    """A text stream that discards text once it can't be written any more."""

    def __init__(self, stream: TextIO | None) -> None:
        """Wrap `stream`, which is None in a process that was started without one."""
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115  (as long as the process)
        self.lost: str | None = None
        """Reason why nothing more can be written; None while writing works."""
        self._when_lost: list[Callable[[], object]] = []

    def write(self, text: str) -> int:
        """Write a text, or discard it if it can't be written; return the number of characters."""
        if self.lost is None:
            with self._watched():
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        if self.lost is None:
            with self._watched():
                self._stream.flush()

    def when_lost(self, do: Callable[[], object]) -> None:
        """Call `do` as soon as nothing can be written any more; at once, if that is already so."""
        if self.lost is not None:
            do()
        self._when_lost.append(do)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except UnicodeError:  # the terminal's encoding lacks a character
            raise
        except (OSError, ValueError) as error:  # ValueError: the stream was closed
            self.lost = _why(error)
            if self._stream in (sys.__stdout__, sys.__stderr__):  # text in Python's buffer must not fail at exit
                with suppress(OSError, ValueError):
                    nowhere = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(nowhere, self._stream.fileno())
                    os.close(nowhere)
            for do in self._when_lost:
                do()

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the text stream."""
        return getattr(self._stream, name)


def _why(error: OSError | ValueError) -> str:
    if isinstance(error, ValueError) or error.errno in (errno.EPIPE, errno.EBADF, errno.EIO):
        return "the output was closed"
    return f"the output can't be written: {DISK_FULL if error.errno == errno.ENOSPC else reason(error)}"


def when_output_is_lost(do: Callable[[], object]) -> None:
    """Call `do` once nothing can be written to standard output any more. Outside of a command it is never called."""
    if isinstance(sys.stdout, Output):
        sys.stdout.when_lost(do)


@contextmanager
def forgiving_output() -> Iterator[Output]:
    """Make losses of standard output and standard error of this process silent; yield the wrapped standard output."""
    streams = sys.stdout, sys.stderr
    output = Output(sys.stdout)
    sys.stdout, sys.stderr = output, Output(sys.stderr)  # type: ignore[assignment]
    try:
        yield output
    finally:
        output.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = streams
