"""Imports run without garbage collection, which is as it was afterwards."""

import gc
import os
import subprocess
import sys

import pytest

from legged.process.startup import importing


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


def test_only_a_command_keeps_what_it_imported_from_the_collector():
    code = (
        "import gc, sys\n"
        "from legged.tools import train\n"
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


@pytest.mark.parametrize("module", ["legged.tools.train", "legged.tools.play"])
def test_modules_are_commands_too(module):
    done = run_module(module, "--task", "nonsense")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --task: there is no task 'nonsense'")


def test_a_machine_without_git_hears_nothing_of_it(tmp_path):
    done = run_module("legged.tools.train", "--task", "anymal_c_flat", "--sim_device", "cpu", "--show", PATH=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")


def test_the_package_lists_its_commands_and_knows_their_short_names(capsys):
    from legged.__main__ import commands, main

    assert {"legged.tools.train", "legged.tools.play", "legged.tools.evaluate", "legged.tools.compare"} <= commands().keys()
    assert main([]) == 0
    assert "python -m legged.tools.plot" in capsys.readouterr().out
    assert main(["evaluate"]) == 2
    assert "did you mean python -m legged.tools.evaluate?" in capsys.readouterr().err
