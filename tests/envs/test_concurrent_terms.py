"""Terms with the mark `@concurrent` are evaluated before it is known which episodes end, all others afterwards."""

from dataclasses import replace

import pytest
import torch
from helpers import small_config

from legged import concurrent
from legged.config import TaskConfig
from legged.envs import LeggedRobot
from legged.envs.concurrent_terms import ConcurrentTerms
from legged.envs.half_cheetah import HalfCheetah
from legged.envs.humanoid import Humanoid
from legged.envs.marks import is_concurrent
from legged.errors import TermError

CPU = torch.device("cpu")


def noted(notes: list[str], name: str):
    """A term which notes that it is called and gives how many calls there were."""

    def term() -> torch.Tensor:
        notes.append(name)
        return torch.tensor([float(len(notes))])

    return term


def terms_on(streams: int, **settled: torch.Tensor) -> ConcurrentTerms:
    return ConcurrentTerms(CPU, streams, lambda: settled)


def test_marked_terms_are_evaluated_early_and_once_and_others_when_they_are_called():
    notes: list[str] = []
    marked = {name: concurrent(noted(notes, name)) for name in ("a", "b", "c")}
    others = {name: noted(notes, name) for name in ("d", "e")}
    terms = terms_on(2)
    functions = terms.add("_reward_", {"d": others["d"], **marked, "e": others["e"]})
    assert list(functions) == ["d", "a", "b", "c", "e"]
    terms.start()
    assert notes == ["a", "c", "b"]  # by stream: the first, the third; the second
    terms.join()
    assert [functions[name]().item() for name in "abc"] == [1.0, 3.0, 2.0]
    assert [functions[name]().item() for name in "de"] == [4.0, 5.0]
    assert notes[3:] == ["d", "e"]
    assert functions["a"]().item() == 6.0  # a value is taken once: at another time there may be another


def test_without_streams_all_run_when_they_are_called():
    notes: list[str] = []
    terms = terms_on(0)
    functions = terms.add("_reward_", {"a": concurrent(noted(notes, "a"))})
    terms.start()
    terms.join()
    assert not notes
    assert functions["a"]().item() == 1.0


def test_a_marked_term_that_fails_is_named():
    @concurrent
    def broken() -> torch.Tensor:
        raise ValueError("no such joint")

    terms = terms_on(1)
    terms.add("_reward_", {"broken": broken})
    with pytest.raises(TermError, match="_reward_broken: no such joint"):
        terms.start()


ENDED = torch.tensor([True, False])
READERS = {
    "arithmetic": lambda: 2.0 * ENDED,
    "a column": lambda: ENDED[1:].float(),
    "a mask": lambda: torch.where(ENDED, 1.0, 0.0),
    "the tensor itself": lambda: ENDED,
    "a view of it": lambda: ENDED.view(2),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_marked_term_that_reads_what_is_not_settled_is_refused(reader):
    terms = terms_on(1, reset_buf=ENDED)
    terms.add("_metric_", {"ends": concurrent(READERS[reader])})
    with pytest.raises(TermError, match=r"^_metric_ends: reads self\.reset_buf, .* remove @concurrent from this term"):
        terms.start()


def test_only_the_first_evaluation_is_checked():
    """So that the check costs nothing in a training."""
    value = torch.ones(2)
    terms = terms_on(1, reset_buf=ENDED)
    functions = terms.add("_reward_", {"one": concurrent(lambda: value)})
    terms.start()
    value = ENDED
    terms.start()
    assert functions["one"]() is ENDED


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


class EndsAsWell(LeggedRobot):
    @concurrent
    def check_termination(self):
        super().check_termination()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Ends, Measures, Rewards])
def test_a_rollout_is_the_same_whether_or_not_terms_run_early(kind):
    """An override of a hook may change what terms read, so all of them run after it."""
    config = small_config(("env.episode_length_s", 0.5), ("rewards.scales.termination", -10.0))
    plain, turned = LeggedRobot(config), kind(config)
    assert any(plain._concurrent_rewards._functions)
    assert any(plain._concurrent_metrics._functions)
    assert any(plain._concurrent_terminations._functions)
    assert not any(
        (
            turned._concurrent_rewards._functions,
            turned._concurrent_metrics._functions,
            turned._concurrent_terminations._functions,
        )
    )
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

        def _reward_torques(self):  # overrides one with the mark, and has none
            return 100.0 * self.reset_buf

    config = small_config(("env.episode_length_s", 0.6))
    set_scales(config, first=1.0, torques=1.0, second=1.0)
    task = Mine(config)
    task.episode_length_buf = torch.tensor([28, 29, 3, 29])
    _, rewards, dones, _ = task.step(torch.zeros(task.num_envs, task.num_actions))
    assert dones.tolist() == [False, True, False, True]
    assert rewards.tolist() == pytest.approx([0.0, 111.0 * task.dt, 0.0, 111.0 * task.dt])


def test_a_hook_with_the_mark_lets_terms_run_early():
    task = EndsAsWell(small_config())
    assert any(task._concurrent_rewards._functions)


BUFFERS = ("terminated_buf", "time_out_buf", "reset_buf", "valid", "rew_buf")


@pytest.mark.slow
@pytest.mark.parametrize("buffer", BUFFERS)
@pytest.mark.parametrize("kind", ["reward", "metric", "terminate"])
def test_a_users_term_with_the_mark_that_reads_which_episodes_end_is_refused_at_the_start(kind, buffer):
    @concurrent
    def reads(self):
        return getattr(self, buffer) + 1.0 > 0.5 if kind == "terminate" else getattr(self, buffer) + 1.0

    mine = type("Mine", (LeggedRobot,), {f"_{kind}_reads": reads})
    config = small_config()
    if kind == "terminate":
        config = replace(config, terminations=replace(config.terminations, failures=("reads",)))
    if kind == "reward":
        set_scales(config, reads=1.0)
    with pytest.raises(TermError, match=f"^_{kind}_reads: reads self.{buffer}, .* @concurrent"):
        mine(config)


def test_a_task_without_a_checked_step_is_refused_at_its_first_step():
    class Mine(LeggedRobot):
        @concurrent
        def _reward_mine(self):
            return self.reset_buf * ~self.time_out_buf

    config = small_config()
    set_scales(config, mine=1.0)
    task = Mine(config, graph=False)
    with pytest.raises(TermError, match=r"^_reward_mine: reads self\.time_out_buf, "):
        task.step(torch.zeros(task.num_envs, task.num_actions))


def test_a_reward_of_legged_gym_needs_no_mark():
    """Copied into a user's class, its `_reward_termination` has this step's value."""

    class Mine(LeggedRobot):
        def _reward_termination(self):
            return self.reset_buf * ~self.time_out_buf

    config = small_config(("env.episode_length_s", 0.6))
    set_scales(config, termination=1.0)
    task = Mine(config)
    task.episode_length_buf = torch.tensor([28, 29, 3, 4])
    qpos = task.physics.qpos.clone()
    qpos[2, 2] = float("nan")  # a robot whose state is not finite fails
    task.physics.write(torch.ones(4, dtype=torch.bool), qpos, task.physics.qvel.clone())
    failed, reward = [], task.rewards.functions["termination"]
    task.rewards.functions["termination"] = lambda: failed.append(reward()) or failed[-1]
    _, _, dones, extras = task.step(torch.zeros(task.num_envs, task.num_actions))
    assert dones.tolist() == [False, True, True, False]
    assert extras["time_outs"].tolist() == [False, True, False, False]
    assert failed[-1].tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize("kind", [LeggedRobot, HalfCheetah, Humanoid])
def test_built_in_terms_run_early_but_the_one_that_reads_which_episodes_end(kind):
    late = {
        f"{prefix}{name}"
        for prefix in ("_reward_", "_metric_", "_terminate_")
        for name in kind.terms(prefix)
        if not is_concurrent(getattr(kind, f"{prefix}{name}"))
    }
    assert late == ({"_reward_termination"} if kind is LeggedRobot else set())


def test_built_in_terms_with_the_mark_read_nothing_that_is_not_settled():
    scales = {name: 1.0 for name in LeggedRobot.terms("_reward_")}
    limits = (("terminations.min_base_height", 0.1), ("terminations.max_tilt", 1.0))
    config = small_config(("rewards.scales", scales), *limits, ("sim.self_collisions", True))
    assert set(LeggedRobot(config).rewards.names) == set(scales)
