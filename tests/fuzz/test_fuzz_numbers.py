"""Bad numbers at drawn places and times: weights and what the task hands out stay finite, and other robots know nothing."""

import pytest
import torch
from helpers import CALM, ENGINE, TASK
from hypothesis import given
from hypothesis import strategies as st

from legged.envs import LeggedRobot
from legged.learning.captured import CapturedRunner
from legged.learning.rollout import Rollout
from legged.learning.runner import Runner
from legged.registry import _REGISTERED, make_task, register, task_config

pytestmark = pytest.mark.slow

N, STEPS = 6, 4
BAD = st.sampled_from([float("nan"), float("inf"), float("-inf"), 1e30, -1e30, 3e38, 1e15, 1e5])
PLACES = ["reward", "obs", "action", "qpos", "qvel", "torques", "forces", "commands"]


class Poisoned(LeggedRobot):
    """A task whose terms return what the test put into `poison`."""

    def _init_poison(self) -> None:
        self.poison = {name: torch.zeros(self.num_envs) for name in ("reward", "obs")}

    def _reward_mine(self) -> torch.Tensor:
        return getattr(self, "poison", {}).get("reward", self.base_pos[:, 2])

    def _obs_mine(self) -> torch.Tensor:
        return getattr(self, "poison", {}).get("obs", self.base_pos[:, 2]).unsqueeze(1).repeat(1, 3)


def poisoned_task() -> Poisoned:
    group = ["base_lin_vel", "dof_pos", "dof_vel", "actions", "mine"]
    config = {
        "extends": TASK,
        "rewards": {"scales": {"mine": 1.0}},
        "observations": {"groups": {"critic": {"terms": group}, "actor": {"terms": group, "history": 2}}},
        "train": {"algorithm": {"symmetry": False}, "policy": {"actor_hidden_dims": [8], "critic_hidden_dims": [8]}},
    }
    register("poisoned", config, Poisoned)
    try:
        settings = [("env.num_envs", N), ("train.runner.num_steps_per_env", STEPS), *ENGINE, *CALM]
        task = make_task(task_config("poisoned", settings, on_cpu=True))
    finally:
        del _REGISTERED["poisoned"]
    task._init_poison()
    return task


def put(task: Poisoned, place: str, robot: int, value: float, actions: torch.Tensor) -> None:
    targets = {
        "reward": lambda: task.poison["reward"][robot : robot + 1],
        "obs": lambda: task.poison["obs"][robot : robot + 1],
        "action": lambda: actions[robot, 3:5],
        "qpos": lambda: task.physics._qpos[robot, 8:9],
        "qvel": lambda: task.physics._qvel[robot, 2:3],
        "torques": lambda: task.torques[robot],
        "forces": lambda: task.contact_forces[robot],
        "commands": lambda: task.commands[robot, :1],
    }
    targets[place]().fill_(value)


SCHEDULE = st.lists(st.tuples(st.integers(0, 7), st.sampled_from(PLACES), st.integers(0, N - 1), BAD), min_size=1, max_size=6)
"""(step, place, robot, value)."""


@given(schedule=SCHEDULE)
def test_what_a_task_hands_out_is_finite_and_other_robots_know_nothing(schedule):
    task, sound = poisoned_task(), poisoned_task()
    touched = {robot for _, _, robot, _ in schedule}
    others = [i for i in range(N) if i not in touched]
    for each in (task, sound):
        torch.manual_seed(3)
        each.reset()
    for step in range(12):
        found = []
        for each in (task, sound):
            torch.manual_seed(step)
            actions = 0.3 * torch.randn(N, 12)
            each._init_poison()
            for when, place, robot, value in schedule:
                if each is task and when == step:
                    put(task, place, robot, value, actions)
            found.append(each.step(actions))
        (observations, rewards, _, _), (expected, wanted, _, _) = found
        for name in ("actor", "critic"):
            assert torch.isfinite(observations[name]).all()
            assert torch.equal(observations[name][others], expected[name][others])
        assert torch.isfinite(rewards).all()
        assert torch.equal(rewards[others], wanted[others])
    state = (task.base_pos, task.dof_pos, task.dof_vel, task.rewards.sums, task.contacts.air_time)
    assert all(torch.isfinite(tensor).all() for tensor in state), "a robot did not recover within a few steps"


@given(data=st.data(), bad=st.lists(st.tuples(st.integers(0, STEPS - 1), st.integers(0, N - 1), BAD), min_size=1, max_size=5))
def test_bad_samples_never_reach_the_weights(data, bad):
    """Whatever a rollout holds, a captured and a stock update leave finite weights."""
    kind = data.draw(st.sampled_from([CapturedRunner, Runner]))
    runner = kind(poisoned_task())
    if kind is CapturedRunner:
        Rollout(runner.env, runner.alg).collect()
    else:
        alg = runner.alg
        with torch.inference_mode():
            observations = runner.env.get_observations()
            for _ in range(STEPS):
                observations, rewards, dones, extras = runner.env.step(alg.act(observations))
                alg.process_env_step(observations, rewards, dones, extras)
            alg.compute_returns(observations)
    st_ = runner.alg.storage
    targets = [st_.returns, st_.advantages, st_.values, st_.actions, st_.actions_log_prob, st_.observations["actor"]]
    with torch.inference_mode():
        for step, robot, value in bad:
            data.draw(st.sampled_from(targets))[step, robot].fill_(value)
    runner.alg.update()
    tensors = [*runner.alg.actor.state_dict().values(), *runner.alg.critic.state_dict().values()]
    tensors += [tensor for state in runner.alg.optimizer.state.values() for tensor in state.values()]
    assert all(torch.isfinite(tensor).all() for tensor in tensors)
