"""How many launches a control step of the task is: each is some two microseconds of a step of a millisecond."""

import pytest
import torch
from launches import counting
from test_randomised_task import ALL

from legged.registry import make_task, task_config


def launches_of(name, settings=()):
    """What a step of a task launches, by the part of it."""
    task = make_task(task_config(name, [("env.num_envs", 2), ("sim.physics", "mujoco_warp"), *settings]), "cpu")
    actions = torch.zeros(2, task.num_actions)
    task.step(actions)
    with torch.no_grad(), counting() as launches:
        task.step_in_place(actions)
    return launches


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("anymal_c_flat", 123), ("anymal_c", 159)])
def test_a_step_is_few_launches(name, most):
    launches = launches_of(name)
    assert launches.total() <= most, launches


@pytest.mark.slow
def test_motors_and_sensors_with_all_their_errors_are_few_launches_more():
    """Whatever the number of terms and joints: at most 22, where the step of `anymal_c` is 159."""
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
    assert 0 < launches_of("anymal_c", errors).total() - launches_of("anymal_c").total() <= 22


@pytest.mark.slow
def test_everything_random_is_few_launches_more():
    """All properties, kicks and two forces: at most 26. Only the two of kicks and forces are in the step's main line. The
    launches of `draw`, and those of `reset_idx` that redraw properties, are on a second stream.
    """
    without, everything = launches_of("anymal_c_flat"), launches_of("anymal_c_flat", ALL)
    more = {name: count - without[name] for name, count in everything.items() if count > without[name]}
    assert 0 < sum(more.values()) <= 26, more
    assert more.pop("disturb") <= 2
    assert set(more) == {"draw", "reset_idx"}


def test_the_count_is_of_what_runs():
    x = torch.zeros(3, 4)
    with counting() as launches:
        (x[:, 1:].t() + 1.0).sum()
        torch.empty(3).view(1, 3)
    assert launches.total() == 2
