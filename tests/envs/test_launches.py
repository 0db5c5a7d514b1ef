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


def test_motors_and_sensors_with_all_their_errors_are_few_launches_more():
    """Whatever the number of terms and joints: at most 50, where the step of `anymal_c` is 136."""
    errors = [
        ("control.actuator.model", "dc_motor"),
        ("control.actuator.coulomb_friction", {"KFE": 1.0}),
        ("control.actuator.delay", [0, 6]),
        ("control.actuator.delay_varies", True),
        ("observations.bias", {"base_ang_vel": 0.05, "dof_pos": 0.02, "projected_gravity": 0.02}),
        ("observations.delay", {"dof_pos": [0, 2], "dof_vel": [0, 2], "base_ang_vel": [0, 2], "heights": [1, 3]}),
        ("observations.dropped", {"heights": 0.1, "dof_pos": 0.01, "dof_vel": 0.01, "base_ang_vel": 0.01}),
        ("observations.height_map", {"offset": 0.05, "shift": 0.1, "drift": 0.01, "shift_drift": 0.02, "holes": 0.1}),
    ]
    found = []
    for settings in ([], errors):
        task = make_task(task_config("anymal_c", [("env.num_envs", 2), ("sim.physics", "mujoco_warp"), *settings]), "cpu")
        actions = torch.zeros(2, task.num_actions)
        task.step(actions)
        with torch.no_grad(), counting() as launches:
            task.step_in_place(actions)
        found.append(launches.total())
    assert 0 < found[1] - found[0] <= 50


def test_the_count_is_of_what_runs():
    x = torch.zeros(3, 4)
    with counting() as launches:
        (x[:, 1:].t() + 1.0).sum()
        torch.empty(3).view(1, 3)
    assert launches.total() == 2
