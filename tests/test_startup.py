"""Imports run without garbage collection, which is as it was afterwards."""

import gc
import subprocess
import sys

import pytest

from legged.startup import importing


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
        "from legged.rl import train\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 0)\n"
        "train.main(['--task', 'none'])\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 0)\n"
        "sys.argv = ['train.py', '--task', 'none']\n"
        "train.main()\n"
        "print(gc.isenabled(), gc.get_freeze_count() > 10_000)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False", "True", "False", "True", "True"]
