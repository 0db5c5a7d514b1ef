"""The step as one function that a CUDA graph can hold, and the real step under the guard."""

import gc

import pytest
import torch
from torch.overrides import _get_current_function_mode
from torch.utils._python_dispatch import _get_current_dispatch_mode

from legged.config import TaskConfig
from legged.envs import LeggedRobot
from legged.errors import TermError
from legged.graph.step_graph import Branch, ForbidHostReads, HostReadError, StepGraph, calling, garbage_kept
from legged.registry import make_task, task_config

CPU = torch.device("cpu")
NUMBERS = torch.tensor([1.0, -2.0, 3.0])


def test_calling_names_the_term_once():
    """The innermost term is the culprit; the error beneath stays readable and attached."""
    with pytest.raises(TermError) as error, calling("outer"), calling("_reward_mine"):
        raise ValueError("sizes differ")
    assert str(error.value) == "_reward_mine: sizes differ"
    assert isinstance(error.value.__cause__, ValueError)


def test_calling_lets_success_through():
    with calling("_reward_mine"):
        value = 3
    assert value == 3


class Freed:
    """Something in a reference cycle that tells when it is freed."""

    def __init__(self, told: list[str]) -> None:
        self.told, self.me = told, self

    def __del__(self) -> None:
        self.told.append("freed")


def litter(told: list[str]) -> None:
    """Drop a cycle, and so many more that Python's collector, where it is on, runs; then fail, as a capture may."""
    Freed(told)
    for _ in range(200_000):
        cycle: list[object] = []
        cycle.append(cycle)
    assert not told
    raise InterruptedError


@pytest.mark.parametrize("collects", [True, False])
def test_cycles_are_freed_after_a_block_that_keeps_garbage(collects: bool):
    """The destructor of an old CUDA graph breaks a capture in progress."""
    told: list[str] = []
    before = gc.isenabled()
    try:
        gc.enable() if collects else gc.disable()
        with pytest.raises(InterruptedError), garbage_kept():
            litter(told)
        assert gc.isenabled() == collects
        gc.collect()
        assert told == ["freed"]
    finally:
        gc.enable() if before else gc.disable()


def test_step_graph_checks_first_and_then_runs_plainly_on_the_cpu():
    calls = []
    guarded = []

    def function() -> None:
        calls.append(1)
        modes = (_get_current_dispatch_mode(), _get_current_function_mode())
        guarded.append(any(mode is not None for mode in modes))

    step = StepGraph(function, CPU, enabled=True)
    assert len(calls) == 3  # two steps that may set up what they keep, and one that is compared
    step()
    step()
    assert guarded == [True, True, True, False, False]
    assert not step.captured


def test_the_compared_steps_use_up_the_random_numbers_of_one():
    torch.manual_seed(0)
    StepGraph(lambda: torch.rand(3, device=CPU), CPU, enabled=True)
    after = torch.rand(1)
    torch.manual_seed(0)
    torch.rand(3)
    assert torch.equal(after, torch.rand(1))


def test_a_rehearsal_stands_in_where_the_graph_is_checked():
    calls = []
    step = StepGraph(lambda: calls.append("all"), CPU, enabled=True, rehearse=lambda: calls.append("one"))
    step()
    assert calls == ["one", "all"]
    with pytest.raises(HostReadError):
        StepGraph(lambda: None, CPU, enabled=True, rehearse=lambda: NUMBERS[0].item())


def test_step_graph_refuses_a_step_with_a_host_read():
    with pytest.raises(HostReadError, match="reads a value on the host") as error:
        StepGraph(lambda: NUMBERS[0].item(), CPU, enabled=True)
    assert "--no-graph" in "".join([str(error.value), *error.value.__notes__])


def test_step_graph_without_capture_lets_a_host_read_pass():
    """And calls nothing before it is called."""
    seen = []
    step = StepGraph(lambda: seen.append(NUMBERS[0].item()), CPU, enabled=False)
    assert seen == []
    step()
    assert seen == [1.0]


def test_branch_runs_in_order_on_the_cpu():
    order = []
    branch = Branch(CPU)
    order.append("before")
    with branch.fork():
        order.append("beside")
    order.append("after")
    branch.join()
    assert order == ["before", "beside", "after"]


def test_branch_lets_errors_through():
    with pytest.raises(ValueError, match="mine"), Branch(CPU).fork():
        raise ValueError("mine")


# ---- the real step -------------------------------------------------------------------------------------------------------


def config(backend: str) -> TaskConfig:
    changes = {
        "env.num_envs": 4,
        "sim.physics": backend,
        "env.episode_length_s": 0.1,  # 5 control steps, so that resets are among the steps below
        "domain_rand.push_interval_s": 0.06,
        "commands.resampling_time_s": 0.04,
    }
    return task_config("anymal_c_flat", changes.items(), on_cpu=True)


@pytest.mark.slow
def test_the_whole_step_of_the_task_can_be_captured(backend):
    """Steps with resets, pushes and new commands among them, on every back-end."""
    engine, _, on_gpu = backend.partition(", ")
    device = "cuda:0" if on_gpu else "cpu"
    task = make_task(config(engine), device, graph=not on_gpu)
    resets = torch.zeros(4, device=device)
    with torch.inference_mode():
        for _ in range(12):
            task._action_input.normal_()
            with ForbidHostReads():
                task._step()
            resets += task.reset_buf
            assert torch.isfinite(task.observation_groups["actor"].buffer).all()
    assert (resets >= 2).all()


def with_reward() -> TaskConfig:
    cfg = config("mujoco")
    cfg.rewards.scales["mine"] = 1.0
    return cfg


class ReadsOnTheHost(LeggedRobot):
    def _reward_mine(self) -> torch.Tensor:
        return self.base_pos[:, 2] * (1.0 if self.base_pos[0, 2] > 0.0 else 2.0)


def test_a_users_reward_with_a_host_read_is_named():
    cfg = with_reward()
    with pytest.raises(TermError, match="_reward_mine: reads a value on the host"):
        ReadsOnTheHost(cfg)
    task = ReadsOnTheHost(cfg, graph=False)
    _, rewards, _, _ = task.step(torch.zeros(4, 12))
    assert torch.isfinite(rewards).all()


class Forked(LeggedRobot):
    """Terms as forks write them: joints by lists of numbers, constants beside the term."""

    def _reward_mine(self) -> torch.Tensor:
        weights = torch.tensor([1.0, 0.5], device=self.device)
        hips = self.dof_pos[:, [0, 3, 6, 9]] - self.default_dof_pos[[0, 3, 6, 9]]
        return hips.abs().sum(dim=1) + (self.dof_vel[:, [1, 2]] * weights).square().sum(dim=1)


class ForkedCounts(LeggedRobot):
    def __init__(self, *args, **kwargs):
        self.calls = 0
        super().__init__(*args, **kwargs)

    def _reward_mine(self) -> torch.Tensor:
        self.calls += 1
        return self.base_pos[:, 2]


@pytest.mark.slow
def test_joints_by_lists_of_numbers_give_the_same_reward_checked_and_not():
    rewards = []
    for graph in (True, False):
        task = Forked(with_reward(), graph=graph)
        torch.manual_seed(0)
        task.reset()
        task.step(torch.zeros(4, 12))
        hips = task.dof_pos[:, ::3] - task.default_dof_pos[::3]
        rewards.append(task.rewards.functions["mine"]())
        by_hand = hips.abs().sum(dim=1) + task.dof_vel[:, 1].square() + 0.25 * task.dof_vel[:, 2].square()
        torch.testing.assert_close(rewards[-1], by_hand)


@pytest.mark.slow
def test_a_count_in_a_term_is_refused_and_runs_without_a_graph():
    with pytest.raises(TermError, match=r"_reward_mine: self\.calls changed from \d+ to \d+: a CUDA graph repeats"):
        ForkedCounts(with_reward())
    task = ForkedCounts(with_reward(), graph=False)
    task.step(torch.zeros(4, 12))
    assert task.calls >= 1


class Filters(LeggedRobot):
    """Keeps the last velocities the way that eager code does."""

    def _reward_mine(self) -> torch.Tensor:
        change = self.base_lin_vel - getattr(self, "last_lin_vel", self.base_lin_vel)
        self.last_lin_vel = self.base_lin_vel.clone()
        return change.square().sum(dim=1)


def test_a_tensor_made_anew_in_every_step_and_read_in_the_next_is_refused():
    with pytest.raises(TermError, match=r"_reward_mine: reads self\.last_lin_vel, .* self\.last_lin_vel\.copy_"):
        Filters(with_reward())
