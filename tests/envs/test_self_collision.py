"""Contacts of a robot with itself in tasks: the reward, its sensor, and its check."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import small_config

from legged import LeggedRobot
from legged.errors import ConfigError
from legged.mdp.sensors import ContactForces
from legged.physics import GROUND
from legged.registry import make_task, task_config

ON = (("sim.self_collisions", True), ("rewards.scales.self_collision", -10.0))


class Stamping(LeggedRobot):
    def contact_groups(self):
        return super().contact_groups() | {"feet": (["FOOT"], [GROUND])}


def g1(*settings):
    few = (("env.num_envs", 2), ("sim.physics", "mujoco"))
    return make_task(task_config("g1_tracking", [*few, *settings], on_cpu=True))


def test_the_reward_counts_steps_while_a_hand_presses_on_the_hip():
    """The left arm is held behind the trunk's side, with its hand in the hip; the right one hangs free."""
    task = g1(*ON)
    assert isinstance(task.sensors["self_collision"], ContactForces)
    names = list(task.robot.joint_names)
    joints = task.default_dof_pos.repeat(2, 1)
    joints[0, names.index("left_shoulder_roll_joint")] = -0.1
    joints[0, names.index("left_elbow_joint")] = 1.4
    joints[0, names.index("left_shoulder_yaw_joint")] = -1.2
    task.reset_qpos[:, :7] = torch.tensor([0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0])
    task.reset_qpos[:, 7:], task.reset_qvel[:] = joints, 0.0
    task.physics.write(torch.ones(2, dtype=torch.bool), task.reset_qpos, task.reset_qvel)
    model = task.physics.batch.get_model(0)  # with this world's friction and centre of mass
    data, found, largest = mujoco.MjData(model), np.zeros(6), [0.0]
    data.qpos[:] = task.reset_qpos[0].double().numpy()
    for _ in range(4):
        task.physics.step()
        mujoco.mj_step(model, data)
        largest.insert(0, 0.0)
        for k in range(data.ncon):
            mujoco.mj_contactForce(model, data, k, found)
            largest[0] = max(largest[0], np.linalg.norm(found[:3]))
    np.testing.assert_allclose(task.sensors["self_collision"].forces[0], largest[:4], rtol=1e-4, atol=1e-4)
    count = sum(force > 10.0 for force in largest)
    assert 1 <= count <= 3  # the arm is pushed out within the control step
    assert task._reward_self_collision().tolist() == [float(count), 0.0]


def test_a_step_shows_its_own_forces_and_an_episode_begins_without_any():
    """A foot is a sphere and has one contact, whose force is the net force on the foot."""
    task = Stamping(small_config(num_envs=3))
    assert set(task.sensors) == {"height_scan", "feet"}
    for _ in range(20):
        task.step(torch.zeros(3, task.num_actions))
    forces = task.sensors["feet"].forces
    assert (forces > 10.0).all()
    feet = task.contact_forces[:, task.feet_indices].norm(dim=2)
    torch.testing.assert_close(forces[:, 0], feet.amax(dim=1), rtol=1e-5, atol=1e-3)
    saved, before = task.state_dict(), forces.clone()
    task.reset()
    assert (forces == 0.0).all()
    task.load_state_dict(saved)
    assert torch.equal(forces, before)


def test_the_reward_is_refused_without_self_collisions():
    with pytest.raises(ConfigError, match=r"rewards\.scales\.self_collision.*sim\.self_collisions=true, got false"):
        small_config(("rewards.scales.self_collision", -1.0))
