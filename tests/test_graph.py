"""The step as one function that a CUDA graph can hold, and the real step under the guard."""

import pytest
import torch
from torch.overrides import _get_current_function_mode
from torch.utils._python_dispatch import _get_current_dispatch_mode

from legged.envs import LeggedRobot
from legged.errors import TermError
from legged.graph import Branch, ForbidHostReads, HostReadError, StepGraph, calling
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


def config(backend: str):
    changes = {
        "env.num_envs": 4,
        "sim.physics": backend,
        "env.episode_length_s": 0.1,  # 5 control steps, so that resets are among the steps below
        "domain_rand.push_interval_s": 0.06,
        "commands.resampling_time_s": 0.04,
    }
    return task_config("anymal_c_flat", changes.items(), on_cpu=True)


def test_the_whole_step_of_the_task_can_be_captured(backend):
    """Steps with resets, pushes and new commands among them, on every back-end."""
    task = make_task(config(backend))
    resets = torch.zeros(4)
    with torch.inference_mode():
        for _ in range(12):
            task._action_input.normal_()
            with ForbidHostReads():
                task._step()
            resets += task.reset_buf
            assert torch.isfinite(task.observation_groups["actor"].buffer).all()
    assert (resets >= 2).all()


class ReadsOnTheHost(LeggedRobot):
    def _reward_mine(self) -> torch.Tensor:
        return self.base_pos[:, 2] * (1.0 if self.base_pos[0, 2] > 0.0 else 2.0)


def test_a_users_reward_with_a_host_read_is_named():
    cfg = config("mujoco")
    cfg.rewards.scales["mine"] = 1.0
    with pytest.raises(TermError, match="_reward_mine: reads a value on the host"):
        ReadsOnTheHost(cfg)
    task = ReadsOnTheHost(cfg, graph=False)
    _, rewards, _, _ = task.step(torch.zeros(4, 12))
    assert torch.isfinite(rewards).all()
