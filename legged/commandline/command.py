"""Execution of a command: its exit code, and its error message in one line."""

import argparse
import errno
import functools
import inspect
import re
import sys
import sysconfig
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import legged.errors
from legged.commandline.output import forgiving_output
from legged.errors import ConfigError, HostReadError, RunError, TermError
from legged.process.command_parser import CommandParser
from legged.process.paths import full_disk_in, reason
from legged.process.ranks import Ranks
from legged.process.startup import INTERRUPTED, STARTED_S, is_a_command, leave_at_interrupts, raise_at_interrupts

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
    with forgiving_output() as output, _engine_warnings():
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


def _engine_warnings() -> AbstractContextManager[None]:
    """Return a context in which each kind of MuJoCo's warnings is printed once; help and lists do without MuJoCo."""
    if "mujoco" not in sys.modules:
        return nullcontext()
    from legged.physics.engine_warnings import each_warning_once

    return each_warning_once()


def command(main: Callable[[list[str] | None], int]) -> Callable[..., int]:
    """Let the main function of a command end as `run_main` describes. Its argument may be left out then."""
    return functools.partial(run_main, main)


class SubCommand:
    """A command that is a function of parsed arguments: `legged <module> <function>`, or `legged <module>` if it is called
    like its module. In the arguments, `words` is the whole command line, and `start_s` the start of the command on the clock
    of `time.perf_counter` [s]; the start of a process includes its imports.
    """

    def __init__(
        self, run: Callable[[argparse.Namespace], int], examples: Sequence[str], add: Callable[[CommandParser], object]
    ) -> None:
        self._run, self._examples, self._add = run, examples, add

    def build_parser(self) -> CommandParser:
        """Return the parser of the command line."""
        words = dict.fromkeys((self._run.__module__.rpartition(".")[2], self._run.__name__))
        parser = CommandParser(" ".join(["legged", *words]), inspect.getdoc(self._run), *self._examples)
        self._add(parser)
        return parser

    def main(self, argv: list[str] | None = None) -> int:
        """Run the command with these arguments, those of this process if None; return its exit code."""

        def run(words: list[str] | None) -> int:
            args = self.build_parser().parse_intermixed_args(words)
            args.words = sys.argv[1:] if words is None else words
            args.start_s = STARTED_S if words is None else time.perf_counter()
            return self._run(args)

        return run_main(run, argv)


def sub_command(
    *examples: str, add: Callable[[CommandParser], object]
) -> Callable[[Callable[[argparse.Namespace], int]], SubCommand]:
    """Make a function of parsed arguments a sub-command, whose exit code it returns. Its docstring is the description of the
    help, which ends with `examples`; `add` adds its arguments to the parser.
    """
    return lambda run: SubCommand(run, examples, add)


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
        if text is None:
            from legged.user_modules import is_of_a_module  # imported late, because help and lists do not need it

            if not is_of_a_module(_file_of(error)):
                raise
            _say(f"{type(error).__name__}: {' '.join(str(error).split())}{line_of_user(error)}")
            return EXIT_WRONG_INPUT
        _say(text)
    return EXIT_FAILED


def line_of_user(error: BaseException | None) -> str:
    """Return ' (file, line n)' of the innermost line of user code in the traceback of `error`."""
    frames: list[traceback.FrameSummary] = []
    while error is not None:
        frames += traceback.extract_tb(error.__traceback__)
        error = error.__cause__
    users = [frame for frame in frames if _is_of_user(Path(frame.filename))]
    return f" ({users[-1].filename}, line {users[-1].lineno})" if users else ""


def _file_of(error: BaseException) -> str:
    """Return the file in which an error was raised; for a missing attribute, the file that uses it."""
    frames = traceback.extract_tb(error.__traceback__)
    while len(frames) > 1 and frames[-1].name == "__getattr__":
        frames.pop()
    return frames[-1].filename


def _is_of_user(file: Path) -> bool:
    """Return True if a file belongs neither to this package, nor to a library, nor to Python."""
    libraries = {"site-packages", "dist-packages"} & {*file.parts} or file.is_relative_to(sysconfig.get_path("stdlib"))
    return not libraries and not file.is_relative_to(Path(legged.errors.__file__).parent) and file.is_file()


def known_failure(error: BaseException) -> str | None:
    """Return one line about a full disk, a file that can't be written or too little memory, whatever library reported it;
    None for all other errors.
    """
    failed = full_disk_in(error)
    if failed is None and isinstance(error, OSError):
        failed = error if isinstance(error, PermissionError) or error.errno in (errno.EROFS, errno.EMFILE) else None
    if failed is not None:
        return f"{failed.filename}: {reason(failed)}" if failed.filename else reason(failed)
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
