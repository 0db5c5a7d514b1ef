"""Returns, lengths and failures of first full episodes, beside an account kept by hand."""

import numpy as np
import pytest
import torch
from helpers import small_config

from legged.config import override
from legged.policies.episodes import episodes_table, for_episodes, measure_episodes, spread_of
from legged.policies.restore import nominal
from legged.registry import make_task, task_config

ENGINE = [("sim.physics", "mujoco"), ("sim.threads", 1)]


def task_of(name: str, num_envs: int, *changes):
    torch.set_num_threads(1)
    return make_task(task_config(name, [*ENGINE, ("env.num_envs", num_envs), *changes], on_cpu=True))


class Account:
    """A policy of random actions that notes what each step gave."""

    def __init__(self, task) -> None:
        self.task, self.rewards, self.failed, self.ended = task, [], [], []
        self.generator = torch.Generator().manual_seed(3)
        step = task.step

        def noting(actions):
            result = step(actions)
            self.rewards.append(result[1].numpy())
            self.failed.append(task.terminated_buf.numpy().copy())
            self.ended.append(result[2].numpy())
            return result

        task.step = noting

    def __call__(self, observations):
        return torch.rand(self.task.num_envs, self.task.num_actions, generator=self.generator) * 2 - 1

    def first_episode(self, i: int) -> tuple[float, int, bool]:
        """Sum of rewards, steps, and whether it was a failure, of environment i."""
        ends = np.flatnonzero(np.array(self.ended)[:, i])
        last = int(ends[0]) if len(ends) else len(self.ended) - 1
        return float(np.array(self.rewards)[: last + 1, i].sum()), last + 1, bool(np.array(self.failed)[last, i])


@pytest.mark.slow
def test_first_episodes_end_with_a_failure_and_nothing_counts_after_it():
    task = task_of("humanoid", 4, ("env.episode_length_s", 3.0))
    account = Account(task)
    measured = measure_episodes(task, account)
    found = [account.first_episode(i) for i in range(4)]
    returns, lengths, failures = zip(*found, strict=True)
    assert any(np.array(account.ended)[:, i].sum() > 1 for i in range(4))  # humanoids began anew, which does not count
    assert measured["count"] == 4
    assert measured["return"]["mean"] == pytest.approx(np.mean(returns), rel=1e-5)
    assert measured["return"]["std"] == pytest.approx(np.std(returns), rel=1e-4)
    assert (measured["return"]["min"], measured["return"]["max"]) == pytest.approx((min(returns), max(returns)), rel=1e-5)
    assert measured["length"]["mean"] == np.mean(lengths)
    assert measured["failures"] == np.mean(failures) == 1.0
    assert sum(measured["terms"].values()) == pytest.approx(np.mean(returns), rel=1e-5)
    # 5 a step while alive; in the last step it is not.
    assert measured["terms"]["alive"] == pytest.approx(5.0 * (np.mean(lengths) - 1))


def test_nothing_fails_where_nothing_ends_an_episode_but_time():
    task = task_of("half_cheetah", 3, ("env.episode_length_s", 1.0))
    account, seen = Account(task), []
    measured = measure_episodes(task, account, lambda step, so_far: seen.append((step, so_far)))
    assert measured["failures"] == 0.0
    assert measured["length"] == {"mean": 20.0, "std": 0.0, "min": 20.0, "max": 20.0}
    assert [step for step, _ in seen] == list(range(20))
    assert seen[-1][1] == pytest.approx(account.first_episode(0)[0], rel=1e-5)
    # 0.05 s a step: the mean forward velocity is the forward term's return over the number of steps.
    assert measured["metrics"]["x_velocity"] == pytest.approx(measured["terms"]["forward"] / 20, rel=1e-4)


@pytest.mark.slow
def test_returns_are_in_the_unit_of_the_terms_whether_or_not_rewards_are_scaled_by_time():
    """A legged robot's rewards are scale * dt * term."""
    changes = ("env.episode_length_s", 0.2), ("train.runner.num_steps_per_env", 1000)
    task = make_task(override(small_config(num_envs=2), changes))
    account = Account(task)
    measured = measure_episodes(task, account)
    sums = [account.first_episode(i)[0] for i in range(2)]
    assert measured["return"]["mean"] == pytest.approx(np.mean(sums) / task.dt, rel=1e-5)


def test_spread_by_hand():
    assert spread_of([1.0, 2.0, 6.0]) == {"mean": 3.0, "std": pytest.approx((14 / 3) ** 0.5), "min": 1.0, "max": 6.0}


def test_a_policy_is_measured_without_noise_and_randomisation():
    cfg = task_config("humanoid", ENGINE, on_cpu=True)
    assert cfg.domain_rand.ranges
    found = nominal(cfg, for_episodes(cfg, 7))
    assert (found.env.num_envs, found.domain_rand.ranges, found.observations.add_noise) == (7, {}, False)
    assert found.train.runner.num_steps_per_env > round(cfg.env.episode_length_s / cfg.dt)
    assert (found.env.episode_length_s, found.rewards) == (cfg.env.episode_length_s, cfg.rewards)


def test_the_table_has_a_line_a_measure():
    spread = {"mean": 12.34, "std": 1.0, "min": 11.0, "max": 13.0}
    episodes = {"count": 2, "return": spread, "length": spread, "terms": {"run": 3.0}, "failures": 0.25}
    table = episodes_table({**episodes, "metrics": {"x_velocity": 1.5}}, "[x]")
    cells = dict(zip(table.columns[0].cells, table.columns[1].cells, strict=True))
    assert cells["return"] == "12.3"
    assert cells["return of run"] == "3.0"
    assert cells["episodes that ended in a failure"] == "25.0 %"
    assert cells["x_velocity"] == "1.500"
