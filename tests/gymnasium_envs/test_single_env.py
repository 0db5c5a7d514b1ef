"""gymnasium.make: one environment, which is reset by whoever uses it."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from envs_of_gymnasium import actions_of, single
from gymnasium.utils.env_checker import check_env

from legged.envs.half_cheetah import HalfCheetah
from legged.errors import ConfigError
from legged.registry import register

ROBOT = "anymal_c_flat"


@pytest.mark.slow
@pytest.mark.parametrize("observations", ["actor", "dict"])
@pytest.mark.parametrize("task", ["half_cheetah", "humanoid", ROBOT])
def test_gymnasium_s_checker_has_nothing_to_say(task, observations, pictures):
    env = single(task, {"control.clip_actions": 1.0}, observations=observations)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)
    env.close()
    env.close()


def test_the_wrappers_of_make_have_nothing_to_say(recwarn):
    env = gymnasium.make(f"legged/{ROBOT}", config={"sim.threads": 1, "env.episode_length_s": 0.1})
    env.reset(seed=0)
    for action in actions_of(env, 5):
        *_, truncated, _ = env.step(action)
    assert truncated
    assert not [str(w.message) for w in recwarn if "WARN" in str(w.message)]


def test_spaces_are_the_task_s():
    env = single(ROBOT, {"control.clip_actions": 3.0, "observations.clip": 7.0})
    assert env.action_space == gymnasium.spaces.Box(-3.0, 3.0, (12,), np.float32)
    assert env.observation_space == gymnasium.spaces.Box(-7.0, 7.0, (48,), np.float32)
    both = single(ROBOT, {"observations.groups.critic.history": 2}, observations="dict")
    assert {name: box.shape for name, box in both.observation_space.items()} == {"actor": (48,), "critic": (96,)}
    seen, _ = both.reset(seed=1)
    assert both.observation_space.contains(seen)
    together = single(ROBOT, {"train.policy.actor_observations": ["critic", "actor"]})
    np.testing.assert_array_equal(together.reset(seed=1)[0][48:], seen["actor"])


def test_rewards_are_gymnasium_s_own():
    ours, theirs = single("half_cheetah"), gymnasium.make("HalfCheetah-v5").unwrapped
    ours.reset(seed=4)
    theirs.reset(seed=0)
    theirs.set_state(*(part[0].double().numpy() for part in (ours.task.physics.qpos, ours.task.physics.qvel)))
    for action in actions_of(ours, 20):
        seen, reward, *_, infos = ours.step(action)
        expected = theirs.step(action)
        np.testing.assert_allclose(seen, expected[0], rtol=1e-4, atol=1e-4)
        assert reward == pytest.approx(expected[1], abs=2e-4)
        assert infos["reward_control"] == pytest.approx(expected[-1]["reward_ctrl"], abs=1e-6)
        assert reward == pytest.approx(infos["reward_forward"] + infos["reward_control"], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["half_cheetah", ROBOT])
def test_the_last_observation_is_that_of_an_episode_that_goes_on(task):
    """The internal reset is hidden: a twin whose episodes are longer sees the same, noise included."""
    short, long = single(task, {"env.episode_length_s": 0.2}), single(task)
    steps = round(0.2 / short.task.dt)
    seen = [[env.reset(seed=7)[0]] for env in (short, long)]
    for step, action in enumerate(actions_of(short, steps), start=1):
        results = [env.step(action) for env in (short, long)]
        for mine, result in zip(seen, results, strict=True):
            mine.append(result[0])
        assert results[0][1] == results[1][1]
        assert results[0][2:4] == (False, step == steps)
        assert results[1][2:4] == (False, False)
    np.testing.assert_array_equal(seen[0], seen[1])
    with pytest.raises(gymnasium.error.ResetNeeded):
        short.step(action)
    assert not np.array_equal(short.reset()[0], seen[0][-1])
    short.step(action)


def test_a_failure_is_no_truncation():
    env = single("humanoid")
    env.reset(seed=0)
    while True:
        seen, _, terminated, truncated, infos = env.step(np.zeros(17, dtype=np.float32))
        if terminated or truncated:
            break
    assert (terminated, truncated) == (True, False)
    assert not 1.0 <= seen[0] <= 1.5  # the height of the torso, outside of healthy_z
    assert infos["reward_alive"] == 0.0
    assert 1.0 <= env.reset()[0][0] <= 1.5


@pytest.mark.slow
def test_seeds_make_rollouts_and_nothing_else_does():
    env, other = single(ROBOT), single(ROBOT, {"domain_rand.push_interval_s": 0.1})

    def rollout(seed: int) -> np.ndarray:
        seen = [env.reset(seed=seed)[0]]
        for action in actions_of(env, 12):
            torch.rand(3)  # a learner draws from torch's generator
            other.reset()  # and so does another environment
            seen.append(env.step(action)[0])
        return np.stack([*seen, env.reset()[0]])

    first = rollout(5)
    assert not np.array_equal(first, rollout(6))
    np.testing.assert_array_equal(first, rollout(5))


def test_torch_s_own_random_numbers_are_left_alone():
    torch.manual_seed(0)
    expected = torch.rand(4)
    torch.manual_seed(0)
    env = single(ROBOT)
    env.reset(seed=3)
    env.step(np.zeros(12))
    env.reset()
    assert torch.equal(torch.rand(4), expected)


def test_a_seed_forgets_what_a_curriculum_has_learned():
    env = single(ROBOT, {"commands.curriculum.start": 0.5})
    ranges = env.task.command_sampler.ranges.clone()
    env.task.command_curriculum.share.fill_(1.0)
    env.task.command_curriculum.write_ranges(env.task.command_sampler.ranges)
    env.reset()
    assert not torch.equal(env.task.command_sampler.ranges, ranges)
    env.reset(seed=0)
    assert torch.equal(env.task.command_sampler.ranges, ranges)


class Remembers(HalfCheetah):
    """A term that makes its buffer at the first call."""

    def _reward_steps(self) -> torch.Tensor:
        if not hasattr(self, "steps"):
            self.steps = torch.zeros(self.num_envs, device=self.device)
        return self.steps.add_(1.0)


def test_a_seed_puts_back_what_a_term_keeps():
    register("remembers", {"extends": "half_cheetah", "rewards": {"scales": {"steps": 1.0}}}, Remembers)
    env = single("remembers")
    counts = []
    for _ in range(2):
        env.reset(seed=1)
        counts.append([env.step(action)[-1]["reward_steps"] for action in actions_of(env, 3)])
    assert counts[0] == counts[1]
    assert counts[0][2] == counts[0][0] + 2.0


def test_without_a_seed_environments_differ():
    first, second = (single("half_cheetah").reset()[0] for _ in range(2))
    assert not np.array_equal(first, second)


@pytest.mark.slow
def test_pictures_show_the_end_of_an_episode_until_it_is_reset(pictures):
    sizes = {"render_mode": "rgb_array", "width": 96, "height": 64}
    short, long = (single("half_cheetah", {"env.episode_length_s": s}, **sizes) for s in (0.2, 20.0))
    for env in (short, long):
        env.reset(seed=2)
    first = short.render()
    assert (first.shape, first.dtype) == ((64, 96, 3), np.uint8)
    for action in actions_of(short, 4):
        for env in (short, long):
            env.step(action)
    np.testing.assert_array_equal(short.render(), long.render())
    assert not np.array_equal(short.render(), first)
    short.reset(seed=2)
    np.testing.assert_array_equal(short.render(), first)
    for env in (short, long):
        env.close()


def test_nothing_is_shown_without_a_render_mode():
    env = single("half_cheetah")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@pytest.mark.filterwarnings("ignore:.*render_mode:UserWarning")
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"observations": "critics"}, "observations: got 'critics'"),
        ({"render_mode": "human_"}, "render_mode: got 'human_'"),
        ({"device": "gpu"}, "device: 'gpu' is not a device"),
        ({"config": {"env.num_envs": 4}}, "config: env.num_envs"),
        ({"config": ["env.num_envs"]}, "config: expected settings by dotted path"),
        ({"config": {"rewards.scales.foward": 1.0}}, "did you mean 'forward'"),
        ({"physics": "bullet"}, "sim.physics"),
        ({"width": 0}, "width: must be a whole number of pixels from 1 to 16384, got 0"),
        ({"height": 270.5}, "height: must be a whole number of pixels from 1 to 16384, got 270.5"),
        ({"height": "270"}, "height: must be a whole number of pixels from 1 to 16384, got '270'"),
    ],
)
def test_wrong_arguments_are_errors_of_one_line(arguments, text):
    with pytest.raises(ConfigError, match=text) as error:
        gymnasium.make("legged/half_cheetah", **arguments)
    assert "\n" not in str(error.value)


def test_a_reset_takes_no_options():
    env = single("half_cheetah")
    with pytest.raises(ConfigError, match="reset: options"):
        env.reset(options={"reset_mask": [True]})
