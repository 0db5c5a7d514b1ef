"""Observations of some joints: their values, their mirror images, and patterns that do not fit."""

import pytest
import torch
from helpers import ENGINE, small_task

from legged.errors import ConfigError
from legged.registry import make_task, task_config

BODY = ["hip", "knee", "ankle", "waist"]
TERMS = ["dof_pos", "dof_vel", "held_targets"]


def humanoid(*changes):
    settings = [
        ("env.num_envs", 2),
        ("control.held", ["shoulder", "elbow", "wrist"]),
        ("observations.joints", BODY),
        ("observations.groups.critic.terms", TERMS),
        ("domain_rand.held_goals.step", 0.2),
    ]
    return make_task(task_config("g1_flat", [*ENGINE, *settings, *changes], on_cpu=True))


@pytest.mark.slow
def test_legs_and_waist_are_observed_and_arms_only_by_their_targets():
    task = humanoid()
    for _ in range(3):
        observed = task.step(torch.zeros(2, 15))[0]["critic"]
    angles, speeds, targets = observed.split([15, 15, 14], dim=1)
    torch.testing.assert_close(angles, (task.dof_pos - task.default_dof_pos)[:, :15])
    torch.testing.assert_close(speeds, 0.05 * task.dof_vel[:, :15])
    torch.testing.assert_close(targets, task.control.held_offsets)
    assert targets.any()
    assert task.joints("elbow").tolist() == [18, 25]


@pytest.mark.slow
def test_the_mirror_image_exchanges_the_sides_of_what_is_observed():
    """Hip pitch, roll, yaw, knee, ankle pitch, roll on both sides; waist yaw, roll, pitch; then seven joints of each arm."""
    columns, signs = humanoid().mirror_images().groups["critic"]
    legs, arms = [*range(6, 12), *range(6), 12, 13, 14], [*range(7, 14), *range(7)]
    assert columns.tolist() == [*legs, *(15 + i for i in legs), *(30 + i for i in arms)]
    of_legs, of_arm = [1, -1, -1, 1, 1, -1] * 2 + [-1, -1, 1], [1, -1, -1, 1, -1, 1, -1]
    assert signs.tolist() == of_legs * 2 + of_arm * 2


@pytest.mark.slow
def test_wheels_of_the_pattern_show_their_speed_and_not_their_angle():
    one_leg = [("observations.joints", ["FL"]), ("train.algorithm.symmetry", False)]
    task = make_task(task_config("go2w_flat", [("env.num_envs", 2), *ENGINE, *one_leg], on_cpu=True))
    assert task._obs_dof_vel().shape == (2, 4)
    assert task._obs_dof_pos().shape == (2, 3)
    task.dof_vel[:] = torch.arange(16.0)
    wheel = task.robot.joint_names.index(next(name for name in task.robot.joint_names if "FL" in name and "wheel" in name))
    assert wheel in task._obs_dof_vel()[0].tolist()


@pytest.mark.slow
def test_all_joints_are_observed_without_a_pattern():
    task = small_task()
    assert task._obs_dof_vel() is task.dof_vel
    assert task._obs_held_targets().shape == (4, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("observations.joints", ["arm"])], r"command line: observations\.joints: pattern 'arm' matches nothing"),
        ([("observations.joints", ["left"])], r"command line: observations\.joints: joints are observed on one side only"),
        (
            [("control.held", []), ("domain_rand.held_goals.step", 0.0)],
            r"observations\.groups\.critic\.terms: held_targets: control\.held names no joints",
        ),
    ],
)
def test_patterns_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        humanoid(*changes)
