"""Ends of a training from outside: signals, and writer threads that fail."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from legged.process.ranks import Ranks
from legged.process.startup import in_main_thread

SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
"""Signals from Ctrl-C, from a scheduler, and from a terminal that is closed."""


@contextmanager
def stopping_on_signals(stop: Callable[[], object]) -> Iterator[list[int]]:
    """Call `stop` at the first signal, which ends the training after the iteration; raise KeyboardInterrupt at the second.
    Yield a list that collects the signals. The earlier handlers are restored afterwards.

    With several processes, all stop as soon as one is told to. There a second signal has no effect: torchrun passes on the
    signals that the terminal has already sent, and kills processes that take more than half a minute. Outside the main thread
    Python can't handle signals, so none are handled.
    """
    received: list[int] = []
    ranks = Ranks.now()

    def handler(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1 and not ranks.several:
            raise KeyboardInterrupt
        if len(received) == 1 and ranks.first:
            once_more = "" if ranks.several else "; once more to stop at once"
            with suppress(RuntimeError):  # the signal came during another write to the same stream
                print(f"stopping after this iteration, with a checkpoint{once_more}", file=sys.stderr, flush=True)
        stop()

    # A signal that nohup ignores stays ignored: the training is to outlive its terminal.
    numbers = [n for n in SIGNALS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN] if in_main_thread() else []
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield received
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


@contextmanager
def quiet_writers() -> Iterator[None]:
    """Keep writer threads from printing a traceback when they cannot write a file; TensorBoard's writer raises the same error
    again in the caller.
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
