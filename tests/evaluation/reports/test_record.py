"""What a run folder tells of its run: how it ended, with which code and settings; damaged files fail nothing."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from helpers import TASK, TINY_TRAINING, checkpoints, run_folders, tiny_run, wait_for

import legged
from legged.cli.train import train
from legged.config import to_dict
from legged.config.dotted import MISSING
from legged.errors import ConfigError
from legged.evaluation.reports.record import from_task_file, is_running, read_code, read_record, what_changed, words
from legged.learning.captured import CapturedRunner
from legged.learning.timing import TIMING_FILE, Timing, read_timing, write_timing
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")

REPOSITORY = Path(legged.__file__).parents[1]
FLAGS = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", *TINY_TRAINING, "train.runner.save_interval=1"]


def folder_of(name="2026-03-04_05-06-07_wide", **settings) -> Path:
    """A run folder with a configuration and nothing else."""
    config = to_dict(task_config(TASK, [("env.num_envs", 8), *settings.items()], on_cpu=True))
    folder = Path("logs") / TASK / name
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


def times(**other) -> Timing:
    return Timing(**{**vars(Timing(TASK, True, 8, 2, False, 64, 1.5, 0.25, 2.0, "cpu", 0)), **other})


@pytest.mark.slow
def test_a_run_that_came_to_its_end():
    record = read_record(tiny_run("train.runner.run_name=short", iterations=3))
    assert (record.status, record.why, record.done) == ("finished", "3 of 3 iterations", 3)
    assert (record.task, record.at("train.runner.run_name"), record.robots, record.steps_per_iteration) == (
        TASK,
        "short",
        8,
        32,
    )
    assert record.log.dt == pytest.approx(0.02)
    assert record.problems == ()
    assert abs(record.began.timestamp() - time.time()) < 300


@pytest.mark.slow
def test_a_training_that_raises_says_why_it_ended(monkeypatch):
    log = CapturedRunner._log

    def fail(self, made):
        log(self, made)
        if made.iteration == 2:
            raise RuntimeError("the floor\nis lava")

    monkeypatch.setattr(CapturedRunner, "_log", fail)
    with pytest.raises(RuntimeError, match="lava"):
        train.main([*FLAGS, "--max_iterations", "9"])
    (folder,) = run_folders()
    record = read_record(folder)
    assert (record.status, record.done) == ("crashed", 3)
    assert record.why == "after 3 of 9 iterations: RuntimeError: the floor is lava"
    assert read_timing(folder).steps == 96
    assert checkpoints(folder) == [0, 1]


@pytest.mark.slow
def test_a_training_that_was_interrupted(monkeypatch):
    log = CapturedRunner._log
    monkeypatch.setattr(CapturedRunner, "_log", lambda self, *rest: (signal.raise_signal(signal.SIGINT), log(self, *rest)))
    assert train.main([*FLAGS, "--max_iterations", "9"]) == 128 + signal.SIGINT
    record = read_record(*run_folders())
    assert (record.status, record.done) == ("interrupted", 1)


@pytest.mark.slow
def test_a_training_is_running_until_it_is_killed():
    command = [sys.executable, str(REPOSITORY / "train.py"), *FLAGS, "--max_iterations", "100000"]
    with Path("out.txt").open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    try:
        wait_for(lambda: "\nit 1/" in Path("out.txt").read_text(), process)
        (folder,) = run_folders()
        assert read_record(folder).status == "running"
    finally:
        process.kill()
        process.wait()
    record = read_record(folder)
    assert record.status == "killed"
    assert record.done == max(checkpoints(folder), default=-1) + 1 or record.scalars
    assert "no end was written" in record.why


def test_whose_log_is_written(monkeypatch):
    folder = Path("run")
    folder.mkdir()
    assert not is_running(folder)
    here = folder / f"events.out.tfevents.123.{socket.gethostname()}.{os.getpid()}.0"
    here.touch()
    assert is_running(folder)

    def refuse(process, signal):
        raise PermissionError

    with monkeypatch.context() as of_another_user:
        of_another_user.setattr(os, "kill", refuse)
        assert is_running(folder)
    os.utime(here, (0, 0))  # its number is somebody else's by now
    assert not is_running(folder)
    elsewhere = folder / "events.out.tfevents.123.another-host.99.0"
    elsewhere.touch()
    assert is_running(folder)
    os.utime(elsewhere, (time.time() - 600, time.time() - 600))
    assert not is_running(folder)


def test_a_run_of_an_older_version_without_times():
    folder = folder_of(**{"train.runner.max_iterations": 7})
    (folder / "model_6.pt").touch()
    assert read_record(folder).status == "finished"
    (folder / "model_6.pt").rename(folder / "model_5.pt")
    assert read_record(folder).status == "killed"
    write_timing(folder, times(finished=False))
    assert read_record(folder).why.startswith("after 6 of 7 iterations, by a signal")


def test_what_is_damaged_is_named_and_fails_nothing():
    folder = folder_of()
    for name in (TIMING_FILE, "evaluation_mujoco.json"):
        (folder / name).write_text("{")
    (folder / "events.out.tfevents.1").write_text("garbage")
    (folder / "config.yaml").write_text("task: nowhere\nenv: {num_robots: 3}\n")
    record = read_record(folder)
    assert (record.task, record.timing, record.scalars, record.results) == ("nowhere", None, {}, {})
    problems = " ".join(record.problems)
    assert len(record.problems) == 4
    assert all(name in problems for name in ("config.yaml", TIMING_FILE, "evaluation_mujoco.json", "TensorBoard"))
    assert from_task_file(record) is None
    with pytest.raises(ConfigError, match="is no run folder"):
        read_record(folder.parent)


def test_the_state_of_the_code_is_counted(tmp_path):
    text = (
        "legged 0.1.0\ncommit 0123456789abcdef\n M a.py\n?? b.py\n\ndiff --git a/a.py b/a.py\n--- a/a.py\n+++ b/a.py\n"
        "@@ -1,2 +1,3 @@\n-old\n+new\n+more\n same\n"
    )
    (tmp_path / "code.diff").write_text(text)
    code = read_code(tmp_path)
    assert (code.version, code.commit, code.files, code.added, code.removed) == ("0.1.0", "0123456789abcdef", 1, 2, 1)
    assert code.summary == "0123456789, 1 file changed, +2 -1"
    (tmp_path / "code.diff").write_text("legged 0.1.0\nnot in a git repository of its own\n")
    assert read_code(tmp_path).summary == "not known"
    assert read_code(tmp_path / "none").summary == "not known"


# ---- differences -----------------------------------------------------------------------------------------------------


def test_values_are_told_as_yaml_has_them():
    assert [words(value) for value in (MISSING, None, "", 1e-5, [1, 2], True)] == [
        "-",
        "null",
        "''",
        "1.0e-05",
        "[1, 2]",
        "true",
    ]
    assert len(words([0.123456] * 40)) == 60


@pytest.mark.slow
def test_a_run_is_compared_with_its_task_on_the_device_that_it_was_made_on():
    folder = folder_of(**{"rewards.scales.torques": -1e-4})
    write_timing(folder, times())
    found = from_task_file(read_record(folder))
    of_task = task_config(TASK, on_cpu=True)
    assert found == {"env.num_envs": [8, of_task.env.num_envs], "rewards.scales.torques": [-1e-4, -1e-5]}
    (folder / TIMING_FILE).unlink()
    assert from_task_file(read_record(folder)) == found  # the nearer of both
    write_timing(folder, times(device="NVIDIA H200"))
    assert len(from_task_file(read_record(folder))) > len(found)


@pytest.mark.slow
def test_what_changed_in_a_few_words():
    folder = folder_of(**{"rewards.scales.torques": -1e-4, "train.runner.run_name": "cheap", "env.seed": 9})
    write_timing(folder, times())
    assert what_changed(read_record(folder)) == "cheap: env.num_envs 8, scales.torques -0.0001"
    (folder / "note.txt").write_text("torques cost\nten times as much\n")
    assert what_changed(read_record(folder)) == "torques cost ten times as much"
    many = {f"rewards.scales.{name}": -7.0 for name in ("torques", "dof_acc", "collision", "action_rate", "orientation")}
    folder = folder_of("2026-01-01_00-00-00", **many)
    write_timing(folder, times())
    assert what_changed(read_record(folder)).endswith(", 2 more settings")
