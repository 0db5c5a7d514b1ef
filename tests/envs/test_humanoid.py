"""The humanoid's observations, rewards and ends, worked out from C MuJoCo's own numbers."""

import mujoco
import numpy as np
import pytest
import torch

from legged.registry import make_task, task_config

ENGINE = [("sim.physics", "mujoco"), ("sim.threads", 1)]
STILL = [("domain_rand.ranges", {"friction": [1.0, 1.0], "actuator_gain": [0.0, 0.0]})]


def make(num_envs: int, *overrides):
    return make_task(task_config("humanoid", [("env.num_envs", num_envs), *ENGINE, *overrides], on_cpu=True))


def test_a_step_is_that_of_c_mujoco():
    """Five physics steps of 3 ms under controls of 0.4 times the action; observations of 22, 23, 130, 78 and 23 numbers."""
    task = make(2, *STILL)
    model = task.physics.model
    assert (model.opt.timestep, task.dt, task.num_actions) == (0.003, pytest.approx(0.015), 17)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (6, 2, 17)).astype(np.float32)
    worlds = []
    for i in range(2):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = task.physics.qpos[i].numpy(), task.physics.qvel[i].numpy()
        mujoco.mj_forward(model, data)
        worlds.append(data)
    for row in actions:
        observation, reward, _, _ = task.step(torch.from_numpy(row))
        for i, data in enumerate(worlds):
            before = data.subtree_com[1].copy()
            data.ctrl[:] = 0.4 * row[i]
            for _ in range(5):
                mujoco.mj_step(model, data)
            forces = data.qfrc_actuator.copy()
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            seen = [data.qpos[2:], data.qvel, data.cinert[1:].ravel(), data.cvel[1:].ravel(), forces]
            assert [len(part) for part in seen] == [22, 23, 130, 78, 23]
            np.testing.assert_allclose(observation["actor"][i].numpy(), np.concatenate(seen), rtol=2e-3, atol=2e-3)
            velocity = (data.subtree_com[1] - before) / 0.015
            wanted = 1.25 * 2.0 * velocity[0] + 5.0 - 0.1 * float((row[i] ** 2).sum())
            assert float(reward[i]) == pytest.approx(wanted, abs=2e-3)


def test_who_is_too_low_or_too_high_has_failed():
    task = make(4)
    qpos = task.qpos0.repeat(4, 1)
    qpos[:, 2] = torch.tensor([1.4, 0.9, 1.6, 1.1])
    task.physics.write(torch.ones(4, dtype=torch.bool), qpos, torch.zeros_like(task.physics.qvel))
    _, _, dones, extras = task.step(torch.zeros(4, 17))
    assert dones.tolist() == [False, True, True, False]
    assert not extras["time_outs"].any()


@pytest.mark.slow
def test_episodes_begin_near_the_model_s_own_state():
    task = make(3000)
    for found, around in ((task.physics.qpos, task.qpos0), (task.physics.qvel, 0.0)):
        offset = found - around
        assert offset.abs().max() <= 0.0101
        assert offset.std(dim=0).tolist() == pytest.approx([0.01 / np.sqrt(3.0)] * found.shape[1], rel=0.06)


def test_friction_of_all_shapes_and_gains_are_drawn():
    """One friction for all shapes of a humanoid, from 0.6 to 1.4; a gear of 100 becomes 95 to 105 at most."""
    task = make(64)
    friction, gain = (task.randomization.fields[name] for name in ("friction", "actuator_gain"))
    assert 0.6 <= friction.min() < 0.7 < 1.3 < friction.max() <= 1.4
    assert -5.0 <= gain.min() < -4.0 < 4.0 < gain.max() <= 5.0
    shapes = task.physics.batch.expand("geom_friction")[:, :, 0]
    np.testing.assert_allclose(shapes, np.tile(friction.double().numpy()[:, None], shapes.shape[1]), rtol=1e-6)
    gear = task.physics.model.actuator_gear[:, 0]
    pull = gear * task.physics.batch.expand("actuator_gainprm")[:, :, 0]
    np.testing.assert_allclose(pull - gear, np.tile(gain.double().numpy()[:, None], len(gear)), rtol=1e-5, atol=1e-5)


def test_positions_and_velocities_of_the_centre_of_mass_are_logged():
    task = make(8, ("train.runner.num_steps_per_env", 4))
    steps = []
    for _ in range(4):
        _, _, _, extras = task.step(torch.zeros(8, 17))
        steps.append((task.com[:, 0].mean().item(), task.com_velocity[:, 0].mean().item()))
    log = extras["log"]
    assert {"rew_linvel", "rew_alive", "rew_quadctrl"} <= set(log)
    named = ("x_position", "y_position", "distance_from_origin", "x_velocity", "y_velocity")
    assert {f"Metrics/{name}" for name in named} <= set(log)
    assert float(log["Metrics/x_position"]) == pytest.approx(np.mean([x for x, _ in steps]), abs=1e-5)
    assert float(log["Metrics/x_velocity"]) == pytest.approx(np.mean([v for _, v in steps]), abs=1e-4)
