"""Execution of a command: its exit code, and its error message in one line."""

import errno
import functools
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import legged.errors
from legged.commandline.output import forgiving_output
from legged.errors import ConfigError, RunError, TermError
from legged.graph.step_graph import HostReadError
from legged.physics.engine_warnings import each_warning_once
from legged.process.paths import full_disk_in, reason
from legged.process.ranks import Ranks
from legged.process.startup import INTERRUPTED, is_a_command, leave_at_interrupts, raise_at_interrupts
from legged.user_modules import is_of_a_module

EXIT_FAILED = 1
EXIT_WRONG_INPUT = 2
NO_MEMORY = "out of memory; fewer robots (--num-envs) need less"
LACKS_MEMORY = re.compile(r"(?i)out of memory|can't allocate memory|failed to allocate|bad_?alloc|unable to allocate")
"""Pattern in the messages of torch, Warp, NumPy and C++ about too little memory."""


def run_main(main: Callable[[list[str] | None], int], argv: list[str] | None = None) -> int:
    """Run a command, with the arguments of this process if `argv` is None; return its exit code.

    The codes are 0 for success, 1 for a command that could not go on, 2 for wrong input, and 130 after Ctrl-C. The reason is
    printed in one line; only a fault of the program prints a traceback. If standard output is lost, the command goes on and
    still writes its files, and the code is 1.
    """
    if argv is None:
        is_a_command()
        raise_at_interrupts()
    with forgiving_output() as output, each_warning_once():
        leaves = None
        try:
            code = _guarded(main, argv)
        except SystemExit as stop:  # from argparse, after --help or a wrong flag
            leaves, code = stop, stop.code if isinstance(stop.code, int) else 0
        output.flush()
        if output.lost is not None:
            _say(output.lost)
            code = code or EXIT_FAILED
        elif leaves is not None:
            raise leaves
    if argv is None:
        leave_at_interrupts()  # until Python itself has ended
    return code


class Command(Protocol):
    """The main function of a command."""

    def __call__(self, argv: list[str] | None = None) -> int:
        """Run the command with these arguments, those of this process if None; return its exit code."""


def command(main: Callable[[list[str] | None], int]) -> Command:
    """Let the main function of a command end as `run_main` describes."""

    @functools.wraps(main)
    def run(argv: list[str] | None = None) -> int:
        return run_main(main, argv)

    return run


def _guarded(main: Callable[[list[str] | None], int], argv: list[str] | None) -> int:
    """Run a command; return its exit code, however it ends."""
    try:
        return main(argv)
    except ConfigError as error:
        _say(str(error))
        return EXIT_WRONG_INPUT
    except (TermError, HostReadError) as error:
        _say("; ".join([f"{error}{line_of_user(error)}", *getattr(error, "__notes__", ())]))
        return EXIT_WRONG_INPUT
    except RunError as error:
        _say(str(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr, flush=True)
        return INTERRUPTED
    except MemoryError as error:
        _say(f"out of memory: {error}" if str(error) else NO_MEMORY)
    except Exception as error:  # libraries report a full disk, too little memory and Ctrl-C by classes of their own
        if isinstance(error.__context__, KeyboardInterrupt):
            print("interrupted", file=sys.stderr, flush=True)
            return INTERRUPTED
        text = known_failure(error)
        if text is None and is_of_a_module(_file_of(error)):
            _say(f"{type(error).__name__}: {' '.join(str(error).split())}{line_of_user(error)}")
            return EXIT_WRONG_INPUT
        if text is None:
            raise
        _say(text)
    return EXIT_FAILED


def line_of_user(error: BaseException) -> str:
    """Return ' (file, line n)' of the innermost line of user code in the traceback of `error`."""
    found = ""
    behind: BaseException | None = error
    while behind is not None:
        for frame in traceback.extract_tb(behind.__traceback__):
            if _is_of_user(frame):
                found = f" ({frame.filename}, line {frame.lineno})"
        behind = behind.__cause__
    return found


def _file_of(error: BaseException) -> str:
    """Return the file in which an error was raised; for a missing attribute, the file that uses it."""
    frames = traceback.extract_tb(error.__traceback__)
    while len(frames) > 1 and frames[-1].name == "__getattr__":
        frames.pop()
    return frames[-1].filename


def _is_of_user(frame: traceback.FrameSummary) -> bool:
    """Return True if a line belongs neither to this package, nor to a library, nor to Python."""
    file = Path(frame.filename)
    libraries = {"site-packages", "dist-packages"} & {*file.parts} or file.is_relative_to(sysconfig.get_path("stdlib"))
    return not libraries and not file.is_relative_to(Path(legged.errors.__file__).parent) and file.is_file()


def known_failure(error: BaseException) -> str | None:
    """Return one line about a full disk, a file that can't be written or too little memory, whatever library reported it;
    None for all other errors.
    """
    full = full_disk_in(error)
    if full is not None:
        return f"{full.filename}: {reason(full)}" if full.filename else reason(full)
    if isinstance(error, PermissionError) or (isinstance(error, OSError) and error.errno in (errno.EROFS, errno.EMFILE)):
        return f"{error.filename}: {reason(error)}" if error.filename else reason(error)
    if isinstance(error, RuntimeError) and LACKS_MEMORY.search(str(error)):
        return f"out of memory ({str(error).splitlines()[0][:160]}); fewer robots (--num-envs) need less"
    return None


def _say(text: str) -> None:
    """Print the reason why the command ends."""
    try:
        rank = f"rank {Ranks.now().rank}: " if Ranks.now().several else ""
    except ConfigError:  # the number of the process is itself wrong, which is the error
        rank = ""
    print(f"{rank}error: {text}", file=sys.stderr, flush=True)
