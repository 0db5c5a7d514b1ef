"""Imports run without garbage collection, which is as it was afterwards."""

import gc
import os
import subprocess
import sys

import pytest

from legged.process.paths import data_folder
from legged.process.processes import child_environment
from legged.process.startup import STAGES_FILE, importing


def fail_to_import():
    with importing():
        assert not gc.isenabled()
        raise ImportError


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_is_as_it_was_after_imports_even_failed_ones(enabled):
    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(ImportError):
            fail_to_import()
        assert gc.isenabled() == enabled
    finally:
        gc.enable()


@pytest.mark.slow
def test_only_a_command_keeps_what_it_imported_from_the_collector():
    code = (
        "import gc, sys\n"
        "from legged.cli.train import train\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 0)\n"
        "train.main(['--task', 'none'])\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 0)\n"
        "sys.argv = ['train.py', '--task', 'none']\n"
        "train.main()\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 10_000)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False", "True", "False", "True", "True"]


def run_module(*arguments, **environment):
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize(("words", "name"), [(("legged", "train"), "TASK"), (("legged", "play"), "POLICY")])
def test_modules_are_commands_too(words, name):
    done = run_module(*words, "nonsense")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {name}: there is no task")
    assert "'nonsense'" in done.stderr


@pytest.mark.slow
def test_a_machine_without_git_hears_nothing_of_it(tmp_path):
    done = run_module("legged", "train", "--task", "anymal_c_flat", "--sim_device", "cpu", "--show", PATH=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")


def test_the_package_lists_tasks_and_robots_without_importing_what_they_need():
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "legged", "list"], capture_output=True, text=True, check=True
    )
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "legged.commandline.command" in imported
    assert not imported & {"torch", "mujoco", "numpy", "yaml"}
    lines = [line.split() for line in done.stdout.splitlines()]
    listed = {words[0] for words in lines if words}
    assert {path.stem for path in data_folder("cfg").glob("*.yaml")} <= listed
    assert {path.name for path in (data_folder("resources") / "robots").iterdir()} <= listed
    assert ["go2", "Unitree", "Go2"] in lines
    assert ["g1_flat", "Unitree's", "G1", "follows", "velocity", "commands", "on", "flat", "ground"] in lines


@pytest.mark.slow
def test_another_programs_m_legged_is_not_meant(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import legged, sys; print(legged.LeggedRobot.__name__, sys.argv[1:])")
    done = subprocess.run([sys.executable, script, "-m", "legged"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "LeggedRobot ['-m', 'legged']"


def test_a_list_that_nobody_reads_ends_in_one_line():
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "legged"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_start_of_a_process_that_a_timed_one_begins_is_not_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv(STAGES_FILE, str(tmp_path / "stages"))
    code = "from legged.process.startup import stage_ended; stage_ended('mine')"
    subprocess.run([sys.executable, "-c", code], env=child_environment(), check=True)
    assert not (tmp_path / "stages").exists()
    subprocess.run([sys.executable, "-c", code], check=True)
    assert "mine" in (tmp_path / "stages").read_text()
