"""The half cheetah is Gymnasium's, term by term."""

import gymnasium
import numpy as np
import pytest
import torch

from legged.config import override
from legged.registry import make_task, task_config

ENGINE = [("sim.physics", "mujoco"), ("sim.threads", 1)]


@pytest.fixture(scope="module")
def theirs():
    return gymnasium.make("HalfCheetah-v5").unwrapped


def make(num_envs: int, **overrides):
    named = [(name.replace("__", "."), value) for name, value in overrides.items()]
    return make_task(task_config("half_cheetah", [("env.num_envs", num_envs), *ENGINE, *named], on_cpu=True))


def test_observations_and_rewards_are_those_of_gymnasium(theirs):
    """From the same states, under the same actions, step by step: float32 outside, the same engine inside."""
    task = make(3)
    rng = np.random.default_rng(0)
    starts = [(task.physics.qpos[i].double().numpy(), task.physics.qvel[i].double().numpy()) for i in range(3)]
    actions = rng.uniform(-1.0, 1.0, (25, 3, 6)).astype(np.float32)
    ours = [task.step(torch.from_numpy(row)) for row in actions]
    for i, (qpos, qvel) in enumerate(starts):
        theirs.reset(seed=0)
        theirs.set_state(qpos, qvel)
        for step, row in enumerate(actions):
            observation, reward, _, _, info = theirs.step(row[i].astype(np.float64))
            np.testing.assert_allclose(ours[step][0]["actor"][i].numpy(), observation, rtol=1e-4, atol=1e-4)
            assert float(ours[step][1][i]) == pytest.approx(reward, abs=2e-4)
    parts = {name: float(value[2]) for name, value in task.rewards.episode_sums.items()}
    assert set(parts) == {"forward", "control"}
    assert info["reward_ctrl"] < 0.0


@pytest.mark.slow
def test_episodes_begin_as_gymnasium_s_do(theirs):
    """Positions evenly within 0.1 of the model's, velocities normal with deviation 0.1."""
    task = make(4000)
    offset = task.physics.qpos - torch.tensor(theirs.init_qpos, dtype=torch.float32)
    assert offset.abs().max() <= 0.1
    assert offset.std(dim=0).tolist() == pytest.approx([0.1 / np.sqrt(3.0)] * 9, rel=0.05)
    assert task.physics.qvel.std(dim=0).tolist() == pytest.approx([0.1] * 9, rel=0.05)
    assert task.physics.qvel.abs().max() > 0.3  # no range ends it


def test_nothing_but_time_ends_an_episode(theirs):
    task = make(2)
    assert (task.max_episode_length, task.dt) == (1000, pytest.approx(theirs.dt))
    assert task.num_actions == theirs.action_space.shape[0]
    upside_down = task.physics.qpos.clone()
    upside_down[:, 2] = 3.1
    task.physics.write(torch.tensor([True, True]), upside_down, task.physics.qvel)
    for _ in range(20):
        _, _, dones, extras = task.step(torch.zeros(2, 6))
        assert not dones.any()
    task.episode_length_buf = torch.tensor([999, 5])
    _, _, dones, extras = task.step(torch.zeros(2, 6))
    assert dones.tolist() == [True, False] == extras["time_outs"].tolist()


def test_actions_beyond_their_range_are_clipped_and_paid_as_clipped():
    one, other = make(1), make(1)
    results = [task.step(torch.full((1, 6), value)) for task, value in ((one, 1.0), (other, 7.0))]
    assert torch.equal(results[0][1], results[1][1])
    assert torch.equal(results[0][0]["actor"], results[1][0]["actor"])


def test_parts_of_the_reward_and_the_velocity_are_logged():
    task = make(4, train__runner__num_steps_per_env=5, env__episode_length_s=0.25)
    actions = torch.full((4, 6), 0.5)
    start = task.physics.qpos[:, 0].clone()
    total = torch.zeros(4)
    for _ in range(4):
        total += task.step(actions)[1]
    before_last = task.physics.qpos[:, 0].clone()
    _, reward, _, extras = task.step(actions)
    log = extras["log"]
    assert float(log["rew_control"]) == pytest.approx(-0.1 * 6 * 0.25)  # a step's mean over the full episode of 5
    both = float(log["rew_forward"] + log["rew_control"])
    assert both == pytest.approx(float((total + reward).mean()) / 5.0, rel=1e-4)
    last = reward + 0.1 * 6 * 0.25
    mean_velocity = ((before_last - start) / 0.05 + last) / 5.0
    assert float(log["Metrics/x_velocity"]) == pytest.approx(float(mean_velocity.mean()), rel=1e-3)


def test_symmetry_is_refused():
    cfg = override(task_config("half_cheetah", on_cpu=True), [("train.algorithm.symmetry", True)])
    with pytest.raises(ValueError, match=r"train\.algorithm\.symmetry: HalfCheetah has no mirror images"):
        make_task(cfg)
