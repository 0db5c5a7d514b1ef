"""gymnasium.make_vec: all environments of a task at once, which are reset within the step that ends their episode."""

import numpy as np
import pytest
import torch
from envs_of_gymnasium import actions_of, single, vector
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

ROBOT = "anymal_c_flat"
TASKS = pytest.mark.parametrize("task", ["half_cheetah", ROBOT])


@TASKS
def test_spaces_are_batches_of_those_of_one_environment(task):
    env, one = vector(task, 64), single(task)
    assert env.num_envs == 64
    assert env.single_observation_space == one.observation_space
    assert env.single_action_space == one.action_space
    assert env.observation_space == batch_space(one.observation_space, 64)
    assert env.action_space == batch_space(one.action_space, 64)
    seen, infos = env.reset(seed=1)
    assert env.observation_space.contains(seen)
    assert infos == {}
    assert len(np.unique(seen, axis=0)) == 64
    seen, rewards, terminated, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(seen)
    assert rewards.shape == terminated.shape == truncated.shape == (64,)
    assert terminated.dtype == truncated.dtype == np.bool_
    env.close()


@pytest.mark.slow
@TASKS
def test_rollouts_with_the_same_seed_are_equal(task):
    env = vector(task, 5, {"env.episode_length_s": 0.2})

    def rollout(seed: int) -> list:
        seen = [env.reset(seed=seed)[0]]
        for action in actions_of(env, 15):
            seen.extend(env.step(action)[:4])
        return seen

    first, other, again = rollout(3), rollout(4), rollout(3)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"observations.groups.actor.history": 3}])
@TASKS
def test_final_observations_are_those_of_episodes_that_go_on(task, settings):
    """A twin whose episodes are longer is in the same state; two of its four environments have another start."""
    short, long = vector(task, 4, {**settings, "env.episode_length_s": 1.0}), vector(task, 4, settings)
    ahead = torch.tensor([short.task.max_episode_length - 4, 0, short.task.max_episode_length - 4, 0])
    for env in (short, long):
        env.reset(seed=11)
    short.task.episode_length_buf = ahead
    for action in actions_of(short, 4):
        mine, reward, terminated, truncated, infos = short.step(action)
        twin = long.step(action)
        np.testing.assert_array_equal(reward, twin[1])
        assert not terminated.any()
    assert truncated.tolist() == [True, False, True, False] == infos["_final_obs"].tolist()
    for env in range(4):
        if truncated[env]:
            np.testing.assert_array_equal(infos["final_obs"][env], twin[0][env])
            assert not np.array_equal(mine[env], twin[0][env])
        else:
            assert infos["final_obs"][env] is None
            np.testing.assert_array_equal(mine[env], twin[0][env])
    kept = infos["final_obs"][0].copy()
    short.step(action)
    np.testing.assert_array_equal(infos["final_obs"][0], kept)


def test_failures_and_time_outs_are_told_apart():
    env = vector(ROBOT, 4)
    env.reset(seed=0)
    env.task.episode_length_buf = torch.tensor([0, env.task.max_episode_length - 1, 0, 0])
    env.task.physics._qpos[2, 2:7] = torch.tensor([0.1, 0.0, 1.0, 0.0, 0.0], dtype=torch.float64)  # on its back
    env.task.physics._qvel[2] = 0.0
    _, _, terminated, truncated, infos = env.step(np.zeros((4, 12)))
    assert truncated.tolist() == [False, True, False, False]
    assert terminated.tolist() == [False, False, True, False]
    gravity = 6 + 2  # z of gravity in the base frame
    assert infos["final_obs"][2][gravity] > 0.9
    assert infos["final_obs"][1][gravity] < -0.9


@pytest.mark.parametrize("observations", ["actor", "dict"])
def test_infos_are_like_those_of_gymnasium_s_own_vector_environment(observations):
    """Keys, types, shapes and masks, before, at and after the end of episodes."""
    settings = {"env.episode_length_s": 0.1}
    ours = vector("half_cheetah", 3, settings, observations=observations)

    def make():
        return single("half_cheetah", settings, observations=observations)

    theirs = SyncVectorEnv([make] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]

    def form(value):
        if isinstance(value, dict):
            return {key: form(part) for key, part in value.items()}
        if isinstance(value, np.ndarray) and value.dtype == object:
            return [form(part) for part in value]
        if isinstance(value, np.ndarray) and value.dtype == bool:
            return value.tolist()
        return (value.shape, value.dtype.kind) if isinstance(value, np.ndarray) else type(value)

    for env in (ours, theirs):
        env.reset(seed=0)
    for action in actions_of(ours, 5):
        mine, expected = ours.step(action), theirs.step(action)
        assert form(mine[:4]) == form(expected[:4])
        infos = {key: value for key, value in expected[4].items() if not (key.startswith("reward_") or "_reward" in key)}
        found = {key: value for key, value in mine[4].items() if not (key.startswith("reward_") or "_reward" in key)}
        assert form(found) == form(infos)
        # Gymnasium leaves out what nobody has; here the mask says so.
        for name in ("reward_forward", "reward_control"):
            ended = mine[2] | mine[3]
            assert mine[4][f"_{name}"].tolist() == (~ended).tolist()
            assert expected[4].get(f"_{name}", np.zeros(3, bool)).tolist() == (~ended).tolist()


def test_parts_of_the_reward_add_up():
    env = vector("half_cheetah", 3, {"env.episode_length_s": 0.2})
    env.reset(seed=0)
    env.task.episode_length_buf = torch.tensor([0, 3, 0])
    _, rewards, _, truncated, infos = env.step(actions_of(env, 1)[0])
    assert truncated.tolist() == [False, True, False]
    sums = infos["reward_forward"] + infos["reward_control"]
    np.testing.assert_allclose(sums[[0, 2]], rewards[[0, 2]], rtol=1e-6)
    last = infos["final_info"]
    assert last["_reward_forward"].tolist() == [False, True, False]
    assert last["reward_forward"][1] + last["reward_control"][1] == pytest.approx(rewards[1], rel=1e-6)


def test_wrappers_of_gymnasium_count_episodes():
    env = DictInfoToList(RecordEpisodeStatistics(vector("half_cheetah", 2, {"env.episode_length_s": 0.2})))
    env.reset(seed=0)
    total = 0.0
    for action in actions_of(env, 4):
        _, rewards, _, _, infos = env.step(action)
        total += rewards[1]
    assert infos[1]["episode"]["l"] == 4
    assert infos[1]["episode"]["r"] == pytest.approx(total, rel=1e-5)
    assert infos[1]["final_obs"].shape == (17,)


def test_tensors_are_the_same_numbers_and_nobody_s_buffers():
    env, other = (vector(ROBOT, 3, {"env.episode_length_s": 0.06}, to_numpy=flag) for flag in (False, True))
    seen, expected = env.reset(seed=2)[0], other.reset(seed=2)[0]
    kept = [(seen, seen.clone())]
    for action in actions_of(env, 4):
        result, array = env.step(torch.from_numpy(action)), other.step(action)
        for mine, theirs in zip(result[:4], array[:4], strict=True):
            assert isinstance(mine, torch.Tensor)
            np.testing.assert_array_equal(mine.numpy(), theirs)
            kept.append((mine, mine.clone()))
        ended = result[4]["_final_obs"]
        assert ended.tolist() == (array[2] | array[3]).tolist()
        kept.append((result[4]["final_obs"], result[4]["final_obs"].clone()))
        for robot in ended.nonzero().flatten().tolist():
            np.testing.assert_array_equal(result[4]["final_obs"][robot].numpy(), array[4]["final_obs"][robot])
    assert all(torch.equal(now, before) for now, before in kept)
    np.testing.assert_array_equal(kept[0][0].numpy(), expected)


def test_wrong_actions_are_refused():
    env = vector("half_cheetah", 2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(N, D\) = \(2, 6\), got \(2, 5\)"):
        env.step(np.zeros((2, 5)))


@pytest.mark.slow
@pytest.mark.parametrize("task", ["half_cheetah", ROBOT, "anymal_c"])
def test_there_is_a_picture_of_every_environment(task, pictures):
    small = {"terrain.num_rows": 2} if task == "anymal_c" else {}
    env = vector(task, 3, small, render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    shown = env.render()
    assert [picture.shape for picture in shown] == [(64, 96, 3)] * 3
    assert [picture.dtype for picture in shown] == [np.uint8] * 3
    assert all((shown[i] != shown[j]).any() for i, j in ((0, 1), (1, 2), (0, 2)))
    again = env.render()
    assert all(np.array_equal(one, other) for one, other in zip(shown, again, strict=True))
    env.close()
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("task", [ROBOT, "anymal_c"])
def test_a_robot_s_picture_is_its_own_and_does_not_depend_on_who_was_drawn_before(task, pictures):
    """Robots that are 0.4 m apart: a camera that glides from one to the next would be in between."""
    small = {"terrain.num_rows": 2} if task == "anymal_c" else {}
    env = vector(task, 3, small, render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    qpos, qvel = env.task.physics.qpos.clone(), torch.zeros(3, 18)
    qpos[:, :7] = qpos[0, :7]
    qpos[:, 0] += torch.tensor([0.0, 0.4, 0.8])
    env.task.commands[:] = env.task.commands[0].clone()

    def shown() -> list[np.ndarray]:
        env.task.physics.write(torch.ones(3, dtype=torch.bool), qpos, qvel)
        env.task.sense()
        return list(env.render())

    first, again = shown(), shown()
    assert all(np.array_equal(one, other) for one, other in zip(first, again, strict=True))
    qpos = qpos.flip(0)
    assert all(np.array_equal(one, other) for one, other in zip(first, shown()[::-1], strict=True))
    env.close()
