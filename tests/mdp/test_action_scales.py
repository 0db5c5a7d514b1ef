"""One action scale or one for each joint, and joints that have no action."""

import json

import pytest
import torch
from helpers import small_task

from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.learning.runner import Runner
from legged.mdp.control import Control
from legged.policies.export import export
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot


def rows(*first_leg: float) -> torch.Tensor:
    """(2, 12): the left front leg's HAA, HFE and KFE as given, the other legs zero."""
    values = torch.zeros(2, 12)
    values[:, :3] = torch.tensor(first_leg)
    return values


def test_scales_by_joint_and_joints_that_are_held_by_hand():
    """HFE scaled by 0.5 and KFE by 2, the left front one by 4; HAA has no action."""
    cfg = RobotControlConfig(
        stiffness={"HAA": 10.0, "HFE": 20.0, "KFE": 30.0},
        damping={"HAA": 0.0, "HFE": 0.0, "KFE": 0.0},
        action_scale={"HFE": 0.5, "KFE": 2.0, "LF_KFE": 4.0},
        held=("HAA",),
    )
    law = Control(load_robot("anymal_c"), cfg, torch.zeros(2, 12), 0.005)
    assert law.acted == (1, 2, 4, 5, 7, 8, 10, 11)
    law.set_actions(torch.tensor([[0.2, -0.1, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0]]).expand(2, 8))
    torques = law.compute(rows(0.1, 0.0, -1.0), torch.zeros(2, 12))
    # Targets 0, 0.1 + 0.4, -0.4 - 0.8 of the left front leg, 0, 0.4, 0.6 - 0.8 of the right one, whose angles are 0.
    assert torques[0, :6].tolist() == pytest.approx([-1.0, 10.0, -6.0, 0.0, 8.0, -6.0])
    law.set_actions(torch.zeros(2, 8))  # nothing of the last ones stays
    assert law.compute(torch.zeros(2, 12), torch.zeros(2, 12))[0, :3].tolist() == pytest.approx([0.0, 8.0, -24.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_scale": {"HFE": 0.5}}, "control.action_scale: no pattern matches joint 'LF_HAA'"),
        ({"action_scale": {"": 0.5}}, "control.action_scale: an empty pattern"),
        ({"action_scale": {"HAA": 0.5, "HFE": 1.0, "KFE": 1.0}, "held": ["HAA"]}, "pattern 'HAA' matches nothing"),
        ({"action_scale": "0.5"}, "control.action_scale: expected a number, or a mapping from names to numbers, got '0.5'"),
        ({"action_scale": {"HAA": -1.0}}, "control.action_scale.HAA: must be above 0"),
        ({"held": ["arm"]}, "control.held: pattern 'arm' matches nothing"),
        ({"held": ["HAA", "HFE", "KFE"]}, "control.held: every joint of 'anymal_c' is held"),
        ({"held": ["HAA"], "control_type": "T"}, "control.held: joints are held by control_type P only, not T"),
        ({"held": ["LF"]}, "control.held: joints are held on one side only"),
    ],
)
def test_scales_and_held_joints_that_do_not_fit_the_robot(changes, message):
    with pytest.raises(ConfigError, match=r"^command line: ") as error:
        make_task(task_config("anymal_c_flat", [(f"control.{key}", value) for key, value in changes.items()], on_cpu=True))
    assert message in str(error.value)


HUMANOID = [
    ("robot", "g1"),
    ("control.action_scale", {"hip": 0.5, "knee": 0.35, "ankle": 0.44, "waist": 0.2}),
    ("control.held", ["shoulder", "elbow", "wrist"]),
    ("train.policy.actor_hidden_dims", [8]),
    ("train.policy.critic_hidden_dims", [8]),
]


@pytest.mark.slow
def test_a_task_whose_arms_are_held_has_fewer_actions_than_joints(tmp_path):
    """15 of 29: observations see all joints, actions and their mirror images those that have one, and so does the export."""
    task = small_task(*HUMANOID, num_envs=2)
    assert task.num_actions == task.actions.shape[1] == 15
    assert task.dof_pos.shape[1] == task.torques.shape[1] == 29
    columns, signs = task.mirror_images().actions
    # Left hip pitch takes the right one's place, waist yaw and roll turn around, waist pitch does not.
    assert columns.tolist() == [6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5, 12, 13, 14]
    assert signs.tolist() == [1, -1, -1, 1, 1, -1] * 2 + [-1, -1, 1]
    start = task.dof_pos[:, 15:].clone()
    for _ in range(3):
        task.step(torch.ones(2, 15))
    assert (task.dof_pos[:, 15:] - start).abs().max() < 0.3
    export(task, Runner(task).alg.get_policy(), tmp_path)
    told = json.loads((tmp_path / "policy.json").read_text())
    assert told["action_joints"] == list(task.robot.joint_names[:15])
    assert told["action_scale"] == pytest.approx([0.5, 0.5, 0.5, 0.35, 0.44, 0.44] * 2 + [0.2] * 3)
    assert len(told["stiffness"]) == len(told["joint_names"]) == 29
    assert [term["size"] for term in told["observation"] if term["name"] in ("dof_pos", "actions")] == [29, 15]
