"""Set-up at the start of a process. It is imported before any large package, because its settings shorten the imports."""

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
from legged.process.requirements import say_unmet

STARTED_S = time.perf_counter()
"""Time at which this package was first imported, on the clock of `time.perf_counter` [s]."""
INTERRUPTED = 128 + signal.SIGINT
"""Exit code of a command that Ctrl-C ended."""

# A waiting thread of torch spins by default. On a busy machine a spinning thread takes the core from the thread for which it
# waits, and updates take ten to a hundred times as long. torch reads this variable once, when it is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# rsl-rl imports GitPython, which prints a long warning where git is missing. This package calls git itself.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")


STAGES_FILE = "LEGGED_STAGES"
"""Environment variable that names the file to which each finished stage of a start is written, e.g. for benchmarks."""


def stage_ended(name: str) -> None:
    """Report that a stage of the start has ended, if STAGES_FILE is set."""
    if STAGES_FILE in os.environ:
        with open(os.environ[STAGES_FILE], "a", encoding="utf-8") as file:
            file.write(f"{time.time():.6f} {name}\n")


@contextmanager
def importing() -> Iterator[None]:
    """Switch off garbage collection in a block that imports modules or makes other objects that stay until the process ends.
    Imports make a million objects, and repeated passes over them would take a quarter of the start-up time.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def is_a_command() -> None:
    """Restart garbage collection in a process that is a command of this package. Imported objects are never examined again,
    new ones are collected, and nothing is collected at exit.
    """
    gc.freeze()
    gc.enable()
    atexit.register(gc.freeze)


def command_of_ours() -> str | None:
    """Return how this process was started as a command of this package: 'script' (train.py, play.py), 'module' (python -m
    legged), 'installed' (legged), or None for other processes.

    A multiprocessing child of a command is not a command, although Python gives it the same arguments.
    """
    given = sys.orig_argv
    processes = sys.modules.get("multiprocessing.process")
    if processes is not None and processes.parent_process() is not None:
        return None
    if "-m" in given[:-1]:
        name = given[given.index("-m") + 1]
        return "module" if name == "legged" or name.startswith("legged.") else None
    script = Path(*sys.argv[:1])
    if script.stem == "legged":
        return "installed"
    top = Path(__file__).resolve().parents[2]
    return "script" if script.name in ("train.py", "play.py") and script.resolve().parent == top else None


def program(command: str) -> list[str]:
    """Return the words that call a command of `legged`, in the way in which this process was called."""
    how = command_of_ours()
    if how == "script" and command in ("train", "play"):
        return ["python", str(Path(sys.argv[0]).with_name(f"{command}.py"))]
    return [*(["python", "-m"] if how == "module" else []), "legged", *command.split()]


def only_lists() -> bool:
    """Return True if this process prints help or a list and needs no large import: `legged`, `legged --help`, `legged list`.

    `python -m legged` counts too; while it imports this package, its sys.argv[0] is still '-m'. An argument `-m legged` of
    another program does not count.
    """
    given = sys.orig_argv
    module = sys.argv[:1] == ["-m"] and given[given.index("-m") + 1] == "legged"
    installed = Path(*sys.argv[:1]).stem == "legged"
    return (module or installed) and sys.argv[1:2] in ([], ["--help"], ["-h"], ["list"])


def in_main_thread() -> bool:
    """Return True if this is the main thread, in which signal handlers can be set."""
    return threading.current_thread() is threading.main_thread()


def leave_at_once(_number: int, _frame: FrameType | None) -> None:
    """End the process at Ctrl-C without a traceback. Used where there is nothing to save: during imports, and after a
    command's work.
    """
    with suppress(OSError):
        os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def leave_at_interrupts() -> None:
    """Let Ctrl-C end the process at once, without a traceback. A handler that other code has set stays."""
    if in_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave_at_once)


def raise_at_interrupts() -> None:
    """Undo `leave_at_interrupts`: Ctrl-C raises KeyboardInterrupt again, so that cleanup code runs."""
    if in_main_thread() and signal.getsignal(signal.SIGINT) is leave_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)


if command_of_ours():
    leave_at_interrupts()
    defer_compiler()
    sys.excepthook = say_unmet
    gc.disable()  # `is_a_command` switches it on again
