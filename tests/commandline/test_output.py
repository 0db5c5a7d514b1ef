"""A standard output that goes away ends nothing, and costs one line on standard error."""

import contextlib
import errno
import io
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import TASK, TINY_TRAINING, checkpoints, run_folders

from legged.cli.train import train
from legged.commandline.command import Output, forgiving_output, run_main, when_output_is_lost
from legged.errors import ConfigError, RunError

pytestmark = pytest.mark.usefixtures("workplace")

ARGUMENTS = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", *TINY_TRAINING]


class Failing(io.StringIO):
    """Takes `room` characters, then raises."""

    def __init__(self, room: int, error: Exception) -> None:
        super().__init__()
        self.room, self.error = room, error

    def write(self, text):
        if len(self.getvalue()) + len(text) > self.room:
            raise self.error
        return super().write(text)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), "the output was closed"),
        (OSError(errno.EIO, "Input/output error"), "the output was closed"),  # a terminal that was hung up
        (ValueError("I/O operation on closed file"), "the output was closed"),
        (OSError(errno.ENOSPC, "No space left on device"), "the output can't be written: no space left on the disk"),
        (OSError(errno.EFBIG, "File too large"), "the output can't be written: File too large"),
    ],
)
def test_what_cannot_be_written_is_dropped_and_who_waits_for_it_is_told_once(error, words):
    stream = Failing(5, error)
    output, told = Output(stream), []
    output.when_lost(lambda: told.append("early"))
    assert output.write("12345") == 5
    assert output.lost is None
    assert output.write("6") == 1
    assert output.write("7") == 1
    output.flush()
    assert stream.getvalue() == "12345"
    assert output.lost == words
    output.when_lost(lambda: told.append("late"))
    assert told == ["early", "late"]


@pytest.mark.parametrize(
    ("encoding", "written"), [("ascii", b"? ? 1\n"), ("latin-1", b"\xfc ? 1\n"), ("cp437", b"\x81 ? 1\n")]
)
def test_a_letter_that_a_terminal_lacks_is_a_question_mark(encoding, written):
    output = Output(io.TextIOWrapper(io.BytesIO(), encoding=encoding, newline="\n"))
    assert output.write("ü ⚠ 1\n") == 6
    output.flush()
    assert output.lost is None
    assert output.buffer.getvalue() == written


def test_a_process_without_standard_output_has_one_that_takes_everything(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with forgiving_output() as output:
        print("nobody reads this", flush=True)
        assert not sys.stdout.isatty()
    assert output.lost is None
    assert sys.stdout is None


def test_outside_of_a_command_nothing_is_watched():
    when_output_is_lost(lambda: pytest.fail("called"))


def test_a_trial_that_writes_into_a_file_does_not_depend_on_the_terminal(monkeypatch):
    """A sweep whose terminal is closed goes on: its trainings are not ended."""
    monkeypatch.setattr(sys, "stdout", Failing(0, BrokenPipeError(errno.EPIPE, "Broken pipe")))
    with forgiving_output() as output:
        with contextlib.redirect_stdout(io.StringIO()):
            when_output_is_lost(lambda: pytest.fail("called"))
        print("lost", flush=True)
        assert output.lost is not None


def test_a_command_goes_on_to_its_end_and_then_says_so(monkeypatch, capsys):
    done = []

    def command(_argv):
        print("a table")
        done.append(True)
        return 0

    monkeypatch.setattr(sys, "stdout", Failing(3, BrokenPipeError(errno.EPIPE, "Broken pipe")))
    assert run_main(command, []) == 1
    assert done == [True]
    assert capsys.readouterr().err == "error: the output was closed\n"


# ---- what ends a command ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ConfigError("env.num_envs: too many"), 2, "error: env.num_envs: too many"),
        (RunError("x.png: no space left on the disk"), 1, "error: x.png: no space left on the disk"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (OSError(errno.ENOSPC, "No space left on device", "x.png"), 1, "error: x.png: no space left on the disk"),
        (PermissionError(errno.EACCES, "Permission denied", "x.png"), 1, "error: x.png: Permission denied"),
        (MemoryError(), 1, "error: out of memory; fewer robots (--num-envs) need less"),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 99 bytes\nmore"),
            1,
            "error: out of memory ([enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 99 bytes);"
            " fewer robots (--num-envs) need less",
        ),
    ],
)
def test_an_ended_command_says_why_in_one_line(error, code, line, capsys):
    def command(_argv):
        raise error

    assert run_main(command, []) == code
    assert capsys.readouterr().err == f"{line}\n"


def test_a_folder_that_was_deleted_meanwhile_is_one_line(capsys, tmp_path):
    def command(_argv):
        (tmp_path / "logs" / "a.json").write_text("")

    assert run_main(command, []) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"error: {tmp_path}/logs/a.json: No such file or directory (")
    assert err.count("\n") == 1


def test_what_a_library_makes_of_a_full_disk_is_called_a_full_disk(capsys):
    def command(_argv):
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise RuntimeError("unexpected pos 64 vs 0") from error

    assert run_main(command, []) == 1
    assert capsys.readouterr().err == "error: no space left on the disk\n"


def test_what_c_code_makes_of_an_interrupt_is_called_that(capsys):
    def command(_argv):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise ImportError("numpy.core failed to import")  # noqa: B904

    assert run_main(command, []) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_fault_of_the_program_keeps_its_traceback():
    def command(_argv):
        raise KeyError("a bug")

    with pytest.raises(KeyError, match="a bug"):
        run_main(command, [])


# ---- training --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_training_whose_output_goes_away_stops_with_a_checkpoint(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", Failing(300, BrokenPipeError(errno.EPIPE, "Broken pipe")))
    assert train.main([*ARGUMENTS, "--max_iterations", "100000", "train.runner.save_interval=100000"]) == 1
    assert capsys.readouterr().err == "error: the output was closed\n"
    (folder,) = run_folders()
    assert checkpoints(folder)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_a_full_disk_behind_the_output_leaves_no_traceback_at_exit():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "legged", "train", *ARGUMENTS, "--show"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "error: the output can't be written: no space left on the disk\n"
