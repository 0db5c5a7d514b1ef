"""What may stop a training from outside, and how it then ends: signals, and writers that fail in threads of their own."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from legged.process.ranks import Ranks
from legged.process.startup import in_main_thread

SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
"""Ctrl-C, what a scheduler sends, and what a terminal sends that is closed."""


@contextmanager
def stopping_on_signals(stop: Callable[[], object]) -> Iterator[list[int]]:
    """Let a first signal call `stop`, which ends the training after the iteration, and a second one raise KeyboardInterrupt.
    Gives a list that gets the signals; what handled them before does so again afterwards.

    Of several processes all stop as soon as one is asked to. There a second signal changes nothing: torchrun passes on what
    the terminal has sent already, and kills who takes more than half a minute. In another thread than the main one no signal
    can be handled, and none is.
    """
    received: list[int] = []
    ranks = Ranks.now()

    def handler(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1 and not ranks.several:
            raise KeyboardInterrupt
        if len(received) == 1 and ranks.first:
            once_more = "" if ranks.several else "; once more to stop at once"
            with suppress(RuntimeError):  # the signal came while something else was being written there
                print(f"stopping after this iteration, with a checkpoint{once_more}", file=sys.stderr, flush=True)
        stop()

    # What nohup has set must stay: the training is to outlive its terminal.
    numbers = [n for n in SIGNALS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN] if in_main_thread() else []
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield received
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


@contextmanager
def quiet_writers() -> Iterator[None]:
    """Keep threads that could not write a file from printing a traceback: TensorBoard's raises the same error once more where
    it is used.
    """
    before = threading.excepthook

    def hook(args: threading.ExceptHookArgs) -> None:
        if not isinstance(args.exc_value, OSError):
            before(args)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = before
