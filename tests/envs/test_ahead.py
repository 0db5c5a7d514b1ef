"""Terms ahead of their turn: ours are evaluated before it is known which episodes end, a user's when their turn comes."""

import pytest
import torch
from helpers import small_config, small_task

from legged.config import TaskConfig
from legged.envs import LeggedRobot
from legged.envs.ahead import Ahead
from legged.errors import TermError

CPU = torch.device("cpu")


def noted(notes: list[str], name: str, module: str):
    """A term of a module, which notes that it is called and gives how many calls there were."""

    def term() -> torch.Tensor:
        notes.append(name)
        return torch.tensor([float(len(notes))])

    term.__module__ = module
    return term


def test_terms_of_ours_are_found_ahead_and_once_and_others_when_they_are_asked_for():
    notes: list[str] = []
    ours = {name: noted(notes, name, "legged.envs.terms") for name in ("a", "b", "late", "c")}
    theirs = {"d": noted(notes, "d", "mine"), "e": noted(notes, "e", "legged_too.terms")}
    ahead = Ahead(CPU, 2)
    functions = ahead.take("_reward_", {**ours, **theirs}, frozenset({"late"}))
    assert list(functions) == ["a", "b", "late", "c", "d", "e"]
    ahead.find()
    assert notes == ["a", "c", "b"]  # by line: the first, the third; the second
    ahead.join()
    assert [functions[name]().item() for name in "abc"] == [1.0, 3.0, 2.0]
    assert [functions[name]().item() for name in ("late", "d", "e")] == [4.0, 5.0, 6.0]
    assert notes[3:] == ["late", "d", "e"]
    assert functions["a"]().item() == 7.0  # a value is taken once: at another time there may be another


def test_without_lines_all_have_their_turn():
    notes: list[str] = []
    ahead = Ahead(CPU, 0)
    functions = ahead.take("_reward_", {"a": noted(notes, "a", "legged.envs.terms")})
    ahead.find()
    ahead.join()
    assert not notes
    assert functions["a"]().item() == 1.0


def test_a_term_that_fails_ahead_is_named():
    def broken() -> torch.Tensor:
        raise ValueError("no such joint")

    broken.__module__ = "legged.envs.terms"
    ahead = Ahead(CPU, 1)
    ahead.take("_reward_", {"broken": broken})
    with pytest.raises(TermError, match="_reward_broken: no such joint"):
        ahead.find()


def set_scales(config: TaskConfig, **scales: float) -> None:
    """Let the rewards of a configuration be these."""
    config.rewards.scales.clear()
    config.rewards.scales.update(scales)


# ---- in a task -------------------------------------------------------------------------------------------------------


def rollout(task: LeggedRobot) -> list[torch.Tensor]:
    """What a task gives in 60 steps of short episodes: rewards, ends, observations, then what is logged."""
    torch.manual_seed(5)
    found: list[torch.Tensor] = []
    for _ in range(60):
        observations, rewards, dones, extras = task.step(torch.randn(task.num_envs, task.num_actions))
        found += [rewards, dones, extras["time_outs"], observations["actor"]]
        found += [value for _, value in sorted(extras.get("log", {}).items())]
    return found


class Ends(LeggedRobot):
    def check_termination(self):
        super().check_termination()


class Measures(LeggedRobot):
    def measure(self):
        super().measure()


class Rewards(LeggedRobot):
    def compute_reward(self):
        super().compute_reward()


@pytest.mark.parametrize("kind", [Ends, Measures, Rewards])
def test_a_rollout_is_the_same_whether_or_not_terms_are_found_ahead(kind):
    """Whoever overrides what they run beside may change there what they read, and has all terms when their turn comes."""
    config = small_config(("env.episode_length_s", 0.5), ("rewards.scales.termination", -10.0))
    plain, turned = LeggedRobot(config), kind(config)
    assert any(plain._rewards_ahead._functions)
    assert any(plain._metrics_ahead._functions)
    assert any(plain._endings_ahead._functions)
    assert not any((turned._rewards_ahead._functions, turned._metrics_ahead._functions, turned._endings_ahead._functions))
    ended = 0
    for one, other in zip(rollout(plain), rollout(turned), strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0, equal_nan=True)
        ended += int(one.sum()) if one.dtype == torch.bool else 0
    assert ended > 4


def test_what_an_override_of_the_termination_writes_is_what_rewards_read():
    class Resting(LeggedRobot):
        def check_termination(self):
            super().check_termination()
            self.torques.zero_()

    config = small_config()
    set_scales(config, torques=-1.0)
    task = Resting(config)
    _, rewards, _, _ = task.step(torch.ones(task.num_envs, task.num_actions))
    assert rewards.tolist() == [0.0] * task.num_envs


def test_a_users_reward_knows_which_episodes_end_and_keeps_its_numbers_in_the_order_of_the_scales():
    class Mine(LeggedRobot):
        def _init_buffers(self):
            super()._init_buffers()
            self.kept = torch.zeros(self.num_envs)

        def _reward_first(self):
            self.kept.copy_(self.reset_buf)
            return self.kept.clone()

        def _reward_second(self):
            return 10.0 * self.kept

        def _reward_torques(self):  # of ours, but a user's now
            return 100.0 * self.reset_buf

    config = small_config(("env.episode_length_s", 0.6))
    set_scales(config, first=1.0, torques=1.0, second=1.0)
    task = Mine(config)
    task.episode_length_buf = torch.tensor([28, 29, 3, 29])
    _, rewards, dones, _ = task.step(torch.zeros(task.num_envs, task.num_actions))
    assert dones.tolist() == [False, True, False, True]
    assert rewards.tolist() == pytest.approx([0.0, 111.0 * task.dt, 0.0, 111.0 * task.dt])


def test_terms_that_ask_which_episodes_end_are_named():
    """Of the rewards here, those that change with the buffers of `check_termination`."""
    task = small_task(num_envs=2)
    task.step(torch.ones(2, task.num_actions))
    asking = set()
    for name in LeggedRobot.terms("_reward_"):
        function = getattr(task, f"_reward_{name}")
        before = function().clone()
        for buffer in (task.terminated_buf, task.time_out_buf, task.reset_buf, task.valid):
            buffer.logical_not_()
        if not torch.equal(before, function()):
            asking.add(name)
        for buffer in (task.terminated_buf, task.time_out_buf, task.reset_buf, task.valid):
            buffer.logical_not_()
    assert asking == {"termination"}
