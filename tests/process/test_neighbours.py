"""Trainings that share a device know of each other, whoever started them and however they end."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import lock_descriptor
from helpers import tiny_run

from legged.learning.timing import read_timing
from legged.process import neighbours
from legged.process.neighbours import ENDING, TURN, Neighbours

pytestmark = pytest.mark.usefixtures("workplace")

ANOTHER = """
import sys
from legged.process import neighbours
neighbours.FOLDER = sys.argv[1]
with neighbours.Neighbours("gpu-a"):
    print("in", flush=True)
    sys.stdin.read()
"""


def another() -> subprocess.Popen:
    """A process that is among those on the device, until it is told to end."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(Path(entry or ".").resolve()) for entry in sys.path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", ANOTHER, neighbours.FOLDER], env=environment, **pipes)
    assert process.stdout.readline() == "in\n"
    return process


def test_each_sees_the_others_of_its_own_device_alone():
    with Neighbours("gpu-a") as first, Neighbours("gpu-b") as elsewhere:
        assert first.most == 0
        with Neighbours("gpu-a") as second, Neighbours("gpu-a") as third:
            assert (second.most, third.most) == (1, 2)
            first.look()
            assert first.most == 2
        first.look()
        assert first.most == 2  # at one time; now there are none
        elsewhere.look()
        assert elsewhere.most == 0
    with Neighbours("gpu-a") as later:
        assert later.most == 0


def test_a_training_that_is_killed_is_a_neighbour_no_longer():
    with Neighbours("gpu-a") as first:
        process = another()
        first.look()
        assert first.most == 1
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        folder = Path(neighbours.FOLDER, "gpu-a")
        assert len(list(folder.glob(f"*{ENDING}"))) == 2  # nobody has removed what it left
        with Neighbours("gpu-a") as second:
            assert second.most == 1
        assert len(list(folder.glob(f"*{ENDING}"))) == 1
    assert [path.name for path in folder.iterdir()] == [TURN]


def test_a_process_that_looks_is_not_taken_for_a_training():
    with Neighbours("gpu-a") as first:
        left = Path(neighbours.FOLDER, "gpu-a", f"1.left{ENDING}")
        left.touch()
        with left.with_name(TURN).open("rb") as turn, left.open("rb") as other:  # as another training does while it looks
            assert lock_descriptor(turn.fileno(), blocking=False)
            assert lock_descriptor(other.fileno(), blocking=False)
            first.look()
            assert first.most == 0
        first.look()
        assert first.most == 0
        assert not left.exists()


def test_one_that_begins_and_ends_during_a_training_is_seen_by_a_glance(monkeypatch):
    now = 1000.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    with Neighbours("gpu-a") as first:
        with Neighbours("gpu-a"):
            now += 0.5
            first.glance()
            assert first.most == 0  # it has looked half a second ago
            now += 0.6
            first.glance()
        assert first.most == 1


def test_where_nobody_may_write_a_training_goes_on():
    Path(neighbours.FOLDER).write_text("a file where the folder would be")
    with Neighbours("gpu-a") as alone:
        alone.look()
    assert alone.most == 0


@pytest.mark.slow
def test_times_of_a_training_say_how_many_others_its_device_had():
    with Neighbours("cpu"), Neighbours("cpu"), Neighbours("gpu-a"):
        beside_two = tiny_run(iterations=1)
    alone = tiny_run(iterations=1)
    times = read_timing(beside_two), read_timing(alone)
    assert [each.beside for each in times] == [2, 0]
    assert [each.company for each in times] == [", beside 2 other trainings", ""]
    assert replace(times[0], beside=1).company == ", beside 1 other training"
