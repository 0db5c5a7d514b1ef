"""Signals: a first one stops a training in order, a second one at once; start-up ends in one line."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from helpers import HANG_S, TASK, TINY_TRAINING, checkpoints, run_folders, wait_for

import legged
from legged.cli.train import train
from legged.commandline.command import SIGNALS, quiet_writers, stopping_on_signals
from legged.process import startup

pytestmark = pytest.mark.usefixtures("workplace")

REPOSITORY = Path(legged.__file__).parents[1]


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_and_the_second_one_interrupts(number, capsys):
    before, asked = signal.getsignal(number), []

    def stop_twice():
        with stopping_on_signals(lambda: asked.append(number)) as received:
            signal.raise_signal(number)
            assert asked == received == [number]
            signal.raise_signal(number)

    with pytest.raises(KeyboardInterrupt):
        stop_twice()
    assert asked == [number]
    assert (
        capsys.readouterr().err == "stopping after this iteration, with a checkpoint; a second signal ends the training now\n"
    )
    assert signal.getsignal(number) == before


def test_what_nohup_has_set_stays():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stopping_on_signals(lambda: pytest.fail("asked")) as received:
        signal.raise_signal(signal.SIGHUP)
    assert received == []


def test_another_thread_than_the_main_one_trains_without_handlers():
    codes = []
    flags = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "1", *TINY_TRAINING]
    thread = threading.Thread(target=lambda: codes.append(train.main(flags)))
    thread.start()
    thread.join()
    assert codes == [0]


def test_a_writer_that_fails_in_its_thread_prints_nothing(capsys):
    def fail():
        raise OSError(28, "No space left on device")

    with quiet_writers():
        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()
    assert capsys.readouterr().err == ""


# ---- of whole processes ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def running(*command: str):
    """A process of its own, with its output in out.txt and err.txt; killed in the end."""
    with open("out.txt", "w") as out, open("err.txt", "w") as err:
        process = subprocess.Popen([sys.executable, *command], stdout=out, stderr=err, cwd=os.getcwd())
    try:
        yield process
    finally:
        process.kill()
        process.wait()


TRAIN = [str(REPOSITORY / "train.py"), "--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "100000"]


@pytest.mark.slow
def test_a_terminal_that_is_closed_stops_a_training_with_a_checkpoint():
    with running(*TRAIN, *TINY_TRAINING) as process:
        wait_for(lambda: "\nit 1/" in Path("out.txt").read_text(), process)
        process.send_signal(signal.SIGHUP)
        assert process.wait(timeout=HANG_S) == 128 + signal.SIGHUP
    (folder,) = run_folders()
    done = max(checkpoints(folder))
    assert f"stopped after {done + 1} iterations" in Path("out.txt").read_text()


@pytest.mark.slow
def test_a_second_signal_ends_a_training_at_once_in_one_line():
    slow = ["train.runner.num_steps_per_env=100000"]
    with running(*TRAIN, *TINY_TRAINING, *slow) as process:
        wait_for(lambda: "run folder" in Path("out.txt").read_text(), process)
        process.send_signal(signal.SIGTERM)
        wait_for(lambda: "stopping" in Path("err.txt").read_text(), process)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=HANG_S) == 128 + signal.SIGTERM
    assert Path("err.txt").read_text().splitlines()[1:] == ["interrupted"]
    assert not Path("logs").exists()  # there was no checkpoint to keep


@pytest.mark.slow
@pytest.mark.parametrize("command", [["legged.cli.play"], ["legged", "evaluate"]])
def test_an_interrupt_during_imports_is_one_line(command):
    with running("-X", "importtime", "-m", *command, TASK) as process:  # says on stderr what is imported
        wait_for(lambda: "legged.process.startup" in Path("err.txt").read_text(), process)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=HANG_S) == 130
    said = [line for line in Path("err.txt").read_text().splitlines() if not line.startswith("import time:")]
    assert said == ["interrupted"]


def test_a_program_that_imports_this_package_keeps_its_interrupts():
    code = "import signal, legged; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert startup.command_of_ours() is None  # a test
