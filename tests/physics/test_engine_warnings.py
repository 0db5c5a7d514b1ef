"""MuJoCo's warnings: told once, and in no file."""

import re
from pathlib import Path

import mujoco
import pytest
import torch
from helpers import small_task

from legged.physics.engine_warnings import each_warning_once

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.slow
def test_many_broken_worlds_are_one_line_and_no_file(capfd):
    task = small_task(num_envs=6)
    before = mujoco.get_mju_user_warning()
    with each_warning_once():
        for value in (float("nan"), 1e30):
            task.physics._qpos[:, 2] = value
            task.step(torch.zeros(6, 12))
    assert mujoco.get_mju_user_warning() is before
    err = capfd.readouterr().err
    assert err.count("warning: MuJoCo: Nan, Inf or huge value in QPOS") == 1
    kinds = [re.sub(r"\d+", "#", line) for line in err.splitlines()]
    assert len(kinds) == len(set(kinds)) < 6  # each once, and not one a world
    assert not Path("MUJOCO_LOG.TXT").exists()


@pytest.mark.slow
def test_outside_of_a_command_there_is_no_file_either(capfd):
    """In a notebook, say; a handler that somebody else has set stays."""
    before = mujoco.get_mju_user_warning()
    try:
        mujoco.set_mju_user_warning(None)
        task = small_task(num_envs=2)
        task.physics._qpos[:, 2] = float("nan")
        task.step(torch.zeros(2, 12))
        assert "warning: MuJoCo: Nan, Inf or huge value in QPOS" in capfd.readouterr().err
        assert not Path("MUJOCO_LOG.TXT").exists()
        told = []
        mujoco.set_mju_user_warning(told.append)
        task = small_task(num_envs=2)
        task.physics._qpos[:, 2] = float("nan")
        task.step(torch.zeros(2, 12))
        assert told
        assert "warning" not in capfd.readouterr().err
    finally:
        mujoco.set_mju_user_warning(before)
