"""Execution of a command: exit code, error message in one line, lost output, and signals."""

import argparse
import errno
import inspect
import os
import re
import signal
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import legged.errors
from legged.deploy.command_parser import Argument, CommandParser
from legged.errors import ConfigError, HostReadError, RunError, TermError
from legged.process.paths import DISK_FULL, full_disk_in, reason
from legged.process.ranks import Ranks
from legged.process.startup import (
    INTERRUPTED,
    STARTED_S,
    in_main_thread,
    is_a_command,
    leave_at_interrupts,
    raise_at_interrupts,
)

EXIT_FAILED = 1
EXIT_WRONG_INPUT = 2
NO_MEMORY = "out of memory; fewer robots (--num-envs) need less"
LACKS_MEMORY = re.compile(r"(?i)out of memory|can't allocate memory|failed to allocate|bad_?alloc|unable to allocate")
"""Pattern that matches messages of torch, Warp, NumPy and C++ about a lack of memory."""
OF_LEGGED_GYM = re.compile(r"--(num_envs|load_run|experiment_name|run_name|max_iterations|sim_device|rl_device)(?==|$)")
"""Pattern of options that exist in legged_gym too. They may be written with underscores, as in legged_gym."""
SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
"""Signals from Ctrl-C, from a scheduler, and from a terminal that is closed."""


def run_main(main: Callable[[list[str] | None], int], argv: list[str] | None = None) -> int:
    """Run a command and return its exit code. If `argv` is None, the command gets the arguments of this process.

    The exit code is 0 for success, 1 for a command that failed, 2 for wrong input, and 130 after Ctrl-C. The reason for a
    failure is printed in one line; only a bug prints a traceback. If writing to standard output fails, e.g. because a pipe
    was closed, the command goes on and still writes its files. The exit code is then 1 instead of 0.
    """
    if argv is None:
        is_a_command()
        raise_at_interrupts()
    with forgiving_output() as output, _engine_warnings():
        leaves = None
        try:
            code = _guarded(main, argv)
        except SystemExit as stop:  # argparse raises SystemExit after --help or a wrong flag
            leaves, code = stop, stop.code if isinstance(stop.code, int) else 0
        output.flush()
        if output.lost is not None:
            _say(output.lost)
            code = code or EXIT_FAILED
        elif leaves is not None:
            raise leaves
    if argv is None:
        leave_at_interrupts()  # from here on, Ctrl-C prints no traceback
    return code


def _engine_warnings() -> AbstractContextManager[None]:
    """Return a context that prints each kind of MuJoCo warning once. If MuJoCo is not imported, the context does nothing."""
    if "mujoco" not in sys.modules:
        return nullcontext()
    from legged.physics.engine_warnings import each_warning_once

    return each_warning_once()


class SubCommand:
    """A command that parses its arguments and calls a function with them. Users type `legged <module> <function>`, or
    `legged <module>` if the two names are equal. A `_` in a name becomes a hyphen; a `_` at the end of a name is left out.

    The parsed arguments have two more attributes. `words` is the list of words of the command line. `start_s` is the time at
    which the command started, on the clock of `time.perf_counter` [s]. If the command runs as its own process, this is the
    time before the imports.
    """

    def __init__(self, run: Callable[..., int], examples: Sequence[str], arguments: Sequence[Argument]) -> None:
        self.run, self._examples, self._arguments = run, examples, arguments

    def build_parser(self) -> CommandParser:
        """Return the parser of the command line."""
        names = (*self.run.__module__.split(".")[2:], self.run.__name__)
        words = dict.fromkeys(name.rstrip("_").replace("_", "-") for name in names)
        described = inspect.getdoc(self.run)
        return CommandParser(" ".join(["legged", *words]), described, *self._examples, arguments=self._arguments)

    def parse(self, argv: list[str] | None) -> argparse.Namespace:
        """Parse the command line `argv`, or the arguments of this process if `argv` is None. Return the parsed arguments."""
        words = sys.argv[1:] if argv is None else argv
        hyphened = [OF_LEGGED_GYM.sub(lambda option: option[0].replace("_", "-"), word) for word in words]
        args = self.build_parser().parse_intermixed_args(hyphened)
        args.words = words
        args.start_s = STARTED_S if argv is None else time.perf_counter()
        return args  # type: ignore[no-any-return]

    def main(self, argv: list[str] | None = None) -> int:
        """Run the command and return its exit code. If `argv` is None, the command gets the arguments of this process."""
        return run_main(lambda words: self.run(self.parse(words)), argv)


def sub_command(*examples: str, arguments: Sequence[Argument] = ()) -> Callable[[Callable[..., int]], SubCommand]:
    """Return a decorator that makes a function a sub-command. The function takes parsed arguments and returns an exit code.
    Its docstring is the description in the help, and `examples` are at the end of the help.
    """
    return lambda run: SubCommand(run, examples, arguments)


def _guarded(main: Callable[[list[str] | None], int], argv: list[str] | None) -> int:
    """Run a command and return its exit code. Known errors are printed; an error that looks like a bug is raised again."""
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
    except Exception as error:  # libraries have their own errors for full disks, full memory and Ctrl-C
        if isinstance(error.__context__, KeyboardInterrupt):
            print("interrupted", file=sys.stderr, flush=True)
            return INTERRUPTED
        text = known_failure(error)
        if text is None:
            from legged.user_modules import is_of_a_module  # a late import, because `legged --help` must stay fast

            if is_of_a_module(_file_of(error)):
                _say(f"{type(error).__name__}: {' '.join(str(error).split())}{line_of_user(error)}")
                return EXIT_WRONG_INPUT
            if not (isinstance(error, OSError) and error.filename):
                raise
            text = f"{error.filename}: {reason(error)}{line_of_user(error)}"  # e.g. a folder that was deleted meanwhile
        _say(text)
    return EXIT_FAILED


def line_of_user(error: BaseException | None) -> str:
    """Return ' (file, line n)' for the innermost line of user code in the tracebacks of `error` and its causes, else ''."""
    frames: list[traceback.FrameSummary] = []
    while error is not None:
        frames += traceback.extract_tb(error.__traceback__)
        error = error.__cause__
    users = [frame for frame in frames if _is_of_user(Path(frame.filename))]
    return f" ({users[-1].filename}, line {users[-1].lineno})" if users else ""


def _file_of(error: BaseException) -> str:
    """Return the file that raised an error. If a `__getattr__` raised the error, return the file that read the attribute."""
    frames = traceback.extract_tb(error.__traceback__)
    while len(frames) > 1 and frames[-1].name == "__getattr__":
        frames.pop()
    return frames[-1].filename


def _is_of_user(file: Path) -> bool:
    """Return True if a file belongs neither to this package, nor to a library, nor to Python."""
    libraries = {"site-packages", "dist-packages"} & {*file.parts} or file.is_relative_to(sysconfig.get_path("stdlib"))
    return not libraries and not file.is_relative_to(Path(legged.errors.__file__).parent) and file.is_file()


def known_failure(error: BaseException) -> str | None:
    """Return a one-line message if `error` means a full disk, a file that can't be opened or written, or too little memory.
    Return None for all other errors.
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
    try:
        rank = f"rank {Ranks.now().rank}: " if Ranks.now().several else ""
    except ConfigError:  # the rank in the environment is invalid; `text` must be printed without it
        rank = ""
    print(f"{rank}error: {text}", file=sys.stderr, flush=True)


# ---- lost output -----------------------------------------------------------------------------------------------------


class Output:
    """A text stream that discards text after a write has failed."""

    def __init__(self, stream: TextIO | None) -> None:
        """Wrap `stream`, e.g. standard output. `stream` is None in a process that was started without standard output."""
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115  (open until the process ends)
        self.lost: str | None = None
        """Reason why nothing more can be written; None while writing works."""
        self._when_lost: list[Callable[[], object]] = []

    def write(self, text: str) -> int:
        """Write a text, or discard it if it can't be written; return the number of characters. A character that the stream's
        encoding lacks is written as a question mark.
        """
        if self.lost is None:
            with self._watched():
                try:
                    self._stream.write(text)
                except UnicodeEncodeError:  # the stream's encoding lacks a character
                    encoding = self._stream.encoding
                    self._stream.write(text.encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        if self.lost is None:
            with self._watched():
                self._stream.flush()

    def when_lost(self, do: Callable[[], object]) -> None:
        """Call `do` as soon as writing fails. If writing has already failed, call `do` at once."""
        if self.lost is not None:
            do()
        self._when_lost.append(do)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # a closed stream raises ValueError
            self.lost = _why(error)
            if self._stream in (sys.__stdout__, sys.__stderr__):  # a flush at Python's exit must not fail
                with suppress(OSError, ValueError):
                    nowhere = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(nowhere, self._stream.fileno())
                    os.close(nowhere)
            for do in self._when_lost:
                do()

    def __getattr__(self, name: str) -> Any:
        """Return the attribute `name` of the wrapped stream. Python calls this only for names that this class lacks."""
        return getattr(self._stream, name)


def _why(error: OSError | ValueError) -> str:
    if isinstance(error, ValueError) or error.errno in (errno.EPIPE, errno.EBADF, errno.EIO):
        return "the output was closed"
    return f"the output can't be written: {DISK_FULL if error.errno == errno.ENOSPC else reason(error)}"


def when_output_is_lost(do: Callable[[], object]) -> None:
    """Call `do` as soon as writing to standard output fails. Outside of a command, `do` is never called."""
    if isinstance(sys.stdout, Output):
        sys.stdout.when_lost(do)


@contextmanager
def forgiving_output() -> Iterator[Output]:
    """Replace stdout and stderr by streams that discard text after a failed write. Yield the new stdout."""
    streams = sys.stdout, sys.stderr
    output = Output(sys.stdout)
    sys.stdout, sys.stderr = output, Output(sys.stderr)  # type: ignore[assignment]
    try:
        yield output
    finally:
        output.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = streams


# ---- signals ---------------------------------------------------------------------------------------------------------


@contextmanager
def stopping_on_signals(stop: Callable[[], object]) -> Iterator[list[int]]:
    """Call `stop` at the first signal, so that a training ends after the current iteration. Raise KeyboardInterrupt at the
    second signal. Yield a list to which received signals are appended. The earlier handlers are restored afterwards.

    In a training with several processes, a signal to one process stops all processes. A second signal has no effect there,
    because one Ctrl-C arrives twice: from the terminal and from torchrun. torchrun kills processes that take more than half a
    minute to end. Outside the main thread no handlers are set, because Python refuses to set them.
    """
    received: list[int] = []
    ranks = Ranks.now()

    def handler(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1 and not ranks.several:
            raise KeyboardInterrupt
        if len(received) == 1 and ranks.first:
            once_more = "" if ranks.several else "; a second signal ends the training now"
            with suppress(RuntimeError):  # a print during another write to the same stream raises RuntimeError
                print(f"stopping after this iteration, with a checkpoint{once_more}", file=sys.stderr, flush=True)
        stop()

    # A signal that nohup has set to be ignored stays ignored, so that a training can outlive its terminal.
    numbers = [n for n in SIGNALS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN] if in_main_thread() else []
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield received
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


@contextmanager
def quiet_writers() -> Iterator[None]:
    """Print no traceback for a thread that ends with an OSError, such as TensorBoard's writer thread on a full disk. The next
    call to TensorBoard's writer raises the same error in the calling thread.
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
