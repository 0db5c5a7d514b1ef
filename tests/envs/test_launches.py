"""How many launches a control step of the task is: each is some two microseconds of a step of a millisecond."""

import pytest
import torch
from launches import counting

from legged.registry import make_task, task_config


@pytest.mark.parametrize(("name", "most"), [("anymal_c_flat", 120), ("anymal_c", 136)])
def test_a_step_is_few_launches(name, most):
    small = [("env.num_envs", 2), ("sim.physics", "mujoco_warp")]
    task = make_task(task_config(name, small), "cpu")
    actions = torch.zeros(2, task.num_actions)
    task.step(actions)
    with torch.no_grad(), counting() as launches:
        task.step_in_place(actions)
    assert launches.total() <= most, launches


def test_the_count_is_of_what_runs():
    x = torch.zeros(3, 4)
    with counting() as launches:
        (x[:, 1:].t() + 1.0).sum()
        torch.empty(3).view(1, 3)
    assert launches.total() == 2
