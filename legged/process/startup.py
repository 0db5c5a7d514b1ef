"""Imported before anything heavy: imports are most of a start."""

import atexit
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from legged.process.deferred_compiler import defer_compiler

STARTED_S = time.perf_counter()
"""When this package was first imported, on the clock of `time.perf_counter` [s]."""
INTERRUPTED = 128 + signal.SIGINT
"""Exit code of a command that Ctrl-C ended."""

# A thread of torch's that waits for the others spins by default, which takes the core from the very thread that it waits for
# as soon as something else runs on the machine: updates then take ten to a hundred times as long. It is asked once, by the
# first import of torch.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# rsl-rl imports GitPython, which complains at length where there is no git; this package asks git by itself.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")


STAGES_FILE = "LEGGED_STAGES"
"""Environment variable: a file that is told when each stage of a start has ended, for `legged benchmark startup`."""


def stage_ended(name: str) -> None:
    """Tell who wants to know that a stage of the start has ended."""
    if STAGES_FILE in os.environ:
        with open(os.environ[STAGES_FILE], "a", encoding="utf-8") as file:
            file.write(f"{time.time():.6f} {name}\n")


@contextmanager
def importing() -> Iterator[None]:
    """Import without garbage collection, or build what stays as imports do: they make a million objects, and looking through
    them time and again takes a quarter of a start.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def is_a_command() -> None:
    """Freeze garbage collection in a process that is one of our commands: imports stay, what comes to be from here on is
    collected, and nothing at exit.
    """
    gc.freeze()
    gc.enable()
    atexit.register(gc.freeze)


def command_of_ours() -> str | None:
    """Return how this process was started, if as a command of this package: 'script' (train.py, play.py), 'module' (python -m
    legged) or 'installed' (legged). A process that such a one starts by multiprocessing is no command, though Python gives it
    the same arguments.
    """
    given = sys.orig_argv
    processes = sys.modules.get("multiprocessing.process")
    if processes is not None and processes.parent_process() is not None:
        return None
    if "-m" in given[:-1]:
        name = given[given.index("-m") + 1]
        return "module" if name == "legged" or name.startswith("legged.") else None
    script = Path(sys.argv[0]) if sys.argv and sys.argv[0] else Path("-")
    if script.stem == "legged":
        return "installed"
    top = Path(__file__).resolve().parents[2]
    return "script" if script.name in ("train.py", "play.py") and script.resolve().parent == top else None


def program(command: str) -> list[str]:
    """Return the words that call a command of `legged` in the way in which this process was called."""
    how = command_of_ours()
    if how == "script" and command in ("train", "play"):
        return ["python", str(Path(sys.argv[0]).with_name(f"{command}.py"))]
    return [*(["python", "-m"] if how == "module" else []), "legged", *command.split()]


def only_lists() -> bool:
    """Return whether this process prints help or a list and needs no heavy import: `legged`, `legged --help`, `legged list`.
    Python calls a module '-m' until it has found its file, so that another program's `-m legged` is not meant.
    """
    given = sys.orig_argv
    if sys.argv[:1] == ["-m"] and given[given.index("-m") + 1] == "legged":
        words = given[given.index("-m") + 2 :]
    elif sys.argv and Path(sys.argv[0]).stem == "legged":
        words = sys.argv[1:]
    else:
        return False
    return words[:1] in ([], ["--help"], ["-h"], ["list"])


def in_main_thread() -> bool:
    """Return whether this is the thread in which signal handlers can be set."""
    return threading.current_thread() is threading.main_thread()


def leave_at_once(_number: int, _frame: FrameType | None) -> None:
    """End the process at Ctrl-C where there is nothing to save and Python would print a traceback: during imports, and when a
    command has done its work.
    """
    with suppress(OSError):
        os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def leave_at_interrupts() -> None:
    """Let Ctrl-C end the process at once, without a traceback; a handler that somebody else has set stays."""
    if in_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave_at_once)


def raise_at_interrupts() -> None:
    """Undo `leave_at_interrupts`: Ctrl-C raises KeyboardInterrupt again, so that what was begun is cleaned up."""
    if in_main_thread() and signal.getsignal(signal.SIGINT) is leave_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)


if command_of_ours():
    leave_at_interrupts()
    defer_compiler()
    gc.disable()  # until `is_a_command`
