"""The last step of an episode, kept by a task that is asked to."""

import pytest
import torch
from helpers import small_task, zero_actions

from legged.envs.final_observation import keep_final_step
from legged.registry import make_task, task_config


@pytest.mark.slow
def test_it_is_kept_only_where_somebody_asks():
    task = small_task()
    assert task.step_watcher is None
    kept = keep_final_step(task)
    assert task.step_watcher == kept.take
    assert set(kept.observations) == set(task.observation_groups)


@pytest.mark.slow
@pytest.mark.parametrize("history", [1, 3])
def test_rollouts_are_bit_for_bit_those_of_a_task_that_keeps_nothing(history):
    settings = ("observations.groups.actor.history", history), ("observations.add_noise", True), ("env.episode_length_s", 0.2)
    task, plain = small_task(*settings), small_task(*settings)
    keep_final_step(task)
    results = []
    for one in (task, plain):
        one.load_state_dict(plain.state_dict())
        torch.manual_seed(3)
        one.reset()
        seen = []
        for step in range(24):
            observations, reward, dones, _ = one.step(zero_actions(one) + 0.1 * (step % 3))
            seen += [*observations.values(), reward, dones]
        results.append(seen)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.slow
def test_where_nothing_ends_it_is_what_the_task_shows():
    """No pushes and no new commands: observations, history included, and states are those after the step."""
    settings = ("observations.groups.actor.history", 3), ("observations.add_noise", True)
    task = small_task(*settings, ("commands.resampling_time_s", 100.0), ("commands.heading_command", False))
    kept = keep_final_step(task)
    for step in range(6):
        observations, _, dones, _ = task.step(zero_actions(task) + 0.05 * step)
        assert not dones.any()
        for name, group in observations.items():
            assert torch.equal(kept.observations[name], group)
        assert torch.equal(kept.qpos, task.physics.qpos)
        assert torch.equal(kept.qvel, task.physics.qvel)


@pytest.mark.slow
def test_states_are_those_before_a_reset():
    task = small_task(("env.episode_length_s", 0.02))
    kept = keep_final_step(task)
    task.physics._qpos[1, 2] = 3.0
    task.step(zero_actions(task))
    assert task.reset_buf.all()
    assert kept.qpos[1, 2] == pytest.approx(3.0, abs=0.01)
    assert task.base_pos[1, 2] == pytest.approx(0.6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_captured_step_keeps_it_too():
    short, long = (
        make_task(task_config("half_cheetah", [("env.num_envs", 8), ("env.episode_length_s", seconds)]), "cuda", graph=False)
        for seconds in (0.2, 50.0)
    )
    kept = [keep_final_step(task) for task in (short, long)]
    assert short.captured
    starts = short.state_dict()
    for task in (short, long):
        torch.manual_seed(1)
        task.load_state_dict(starts)
    actions = torch.rand(4, 8, 6, device="cuda") - 0.5
    for row in actions:
        results = [task.step(row) for task in (short, long)]
    assert results[0][2].all()
    torch.testing.assert_close(kept[0].observations["actor"], results[1][0]["actor"], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(kept[0].qpos, long.physics.qpos, rtol=1e-3, atol=1e-3)
    assert not torch.allclose(results[0][0]["actor"], results[1][0]["actor"], atol=1e-3)
