"""The guard that finds, without a GPU, what no CUDA graph can hold; and the real step under it."""

import pytest
import torch

from legged.envs import LeggedRobot
from legged.errors import TermError
from legged.graph import Branch, ForbidHostReads, HostReadError, StepGraph, calling
from legged.registry import make_task, task_config

CPU = torch.device("cpu")
NUMBERS = torch.tensor([1.0, -2.0, 3.0])
MASK = NUMBERS > 0.0


def write_by_mask() -> None:
    NUMBERS.clone()[MASK] = 0.0


def write_by_mask_tensor() -> None:
    NUMBERS.clone()[MASK] = NUMBERS[:2]


def branch_on_a_tensor() -> None:
    if MASK.any():
        pass


REFUSED = {
    "item": lambda: NUMBERS.sum().item(),
    "float": lambda: float(NUMBERS[0]),
    "int": lambda: int(NUMBERS[0]),
    "if": branch_on_a_tensor,
    "is_nonzero": lambda: torch.is_nonzero(NUMBERS[0]),
    "index by a number": lambda: NUMBERS[torch.tensor(1)],
    "nonzero": lambda: MASK.nonzero(),
    "where with one argument": lambda: torch.where(MASK),
    "argwhere": lambda: torch.argwhere(MASK),
    "read by mask": lambda: NUMBERS[MASK],
    "write a number by mask": write_by_mask,
    "write a tensor by mask": write_by_mask_tensor,
    "read by a mask of bytes": lambda: NUMBERS[MASK.to(torch.uint8)],
    "masked_select": lambda: NUMBERS.masked_select(MASK),
}

ALLOWED = {
    "where": lambda: torch.where(MASK, NUMBERS, 0.0),
    "masked_fill": lambda: NUMBERS.masked_fill(MASK, 0.0),
    "read by positions": lambda: NUMBERS[torch.tensor([0, 2])],
    "write by positions": lambda: NUMBERS.clone().index_put_((torch.tensor([1]),), torch.tensor([5.0])),
    "slice and ellipsis": lambda: NUMBERS[None, ..., 1:],
    "draw in place": lambda: NUMBERS.clone().uniform_(),
    "reduce": lambda: (NUMBERS * MASK).sum() / MASK.sum(),
}


@pytest.fixture(params=[False, True], ids=["plain", "inference"])
def inference(request):
    """The task steps in inference mode, where operators reach a dispatch mode in other pieces."""
    with torch.inference_mode(request.param):
        yield


@pytest.mark.filterwarnings("ignore:indexing with dtype torch.uint8")
@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.usefixtures("inference")
def test_what_waits_for_the_host_is_refused(name):
    REFUSED[name]()  # ordinary code outside the guard
    with ForbidHostReads(), pytest.raises(HostReadError, match="CUDA graph"):
        REFUSED[name]()


@pytest.mark.parametrize("name", ALLOWED)
@pytest.mark.usefixtures("inference")
def test_what_a_graph_can_hold_passes(name):
    with ForbidHostReads():
        ALLOWED[name]()


def test_guard_changes_no_results():
    expected = ALLOWED["where"]()
    with ForbidHostReads():
        actual = ALLOWED["where"]()
    assert actual.tolist() == expected.tolist() == [1.0, 0.0, 3.0]


def test_guard_ends_with_its_block_also_after_an_error():
    with pytest.raises(HostReadError), ForbidHostReads():
        NUMBERS[0].item()
    assert NUMBERS[0].item() == 1.0


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


def test_step_graph_checks_once_and_then_runs_plainly_on_the_cpu():
    calls = []
    guarded = []

    def function() -> None:
        calls.append(1)
        guarded.append(torch.utils._python_dispatch._get_current_dispatch_mode() is not None)

    step = StepGraph(function, CPU, enabled=True)
    assert len(calls) == 1
    step()
    step()
    assert guarded == [True, False, False]
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
