"""The step takes what callers have: tensors with gradients, other types, arrays; and refuses other shapes by name."""

import numpy as np
import pytest
import torch
from helpers import small_config, small_task
from torch import Tensor

from legged.envs import LeggedRobot

ACTIONS = torch.linspace(-0.5, 0.5, 48).view(4, 12)


@pytest.fixture(scope="module")
def task():
    return small_task()


def stepped(task: LeggedRobot, actions) -> Tensor:
    """The joint angles that the actions lead to, from the same state each time."""
    torch.manual_seed(0)
    task.reset()
    task.step(actions)
    return task.dof_pos.clone()


@pytest.mark.slow
def test_actions_with_a_gradient_are_stepped_and_nothing_is_spoilt(task):
    expected = stepped(task, ACTIONS)
    network = torch.nn.Linear(48, 12)
    task.reset()
    observations = task.get_observations()
    for _ in range(3):
        actions = network(observations["actor"])
        assert actions.requires_grad
        observations, rewards, _, extras = task.step(actions)
        given = [*observations.values(), rewards, extras["time_outs"]]
        assert not any(tensor.requires_grad or tensor.is_inference() for tensor in given)
    network(observations["actor"]).sum().backward()  # what is learned from them is the caller's
    assert network.weight.grad is not None
    assert not task.actions.requires_grad
    assert torch.equal(stepped(task, ACTIONS), expected)


def test_observations_of_held_commands_can_be_learned_from(task):
    network = torch.nn.Linear(48, 12)
    with torch.no_grad():
        observations = task.hold_commands(torch.zeros(3))
    network(observations["actor"]).sum().backward()
    assert network.weight.grad is not None


class KeepsABuffer(LeggedRobot):
    """Makes a tensor in its first step and writes it in place in all others."""

    def _reward_mine(self) -> Tensor:
        if not hasattr(self, "smooth"):
            self.smooth = torch.zeros_like(self.rew_buf)
        self.smooth += self.base_pos[:, 2]
        return self.smooth


@pytest.mark.slow
@pytest.mark.parametrize("graph", [True, False])
@pytest.mark.parametrize("first", ["inference", "plain", "in place"])
def test_steps_in_and_outside_inference_mode_follow_each_other(graph, first):
    cfg = small_config()
    cfg.rewards.scales["mine"] = 1.0
    task = KeepsABuffer(cfg, graph=graph)

    def inference():
        with torch.inference_mode():
            task.step(ACTIONS)

    def in_place():  # as a captured rollout does it
        with torch.no_grad():
            task.step_in_place(ACTIONS)

    ways = {"inference": inference, "plain": lambda: task.step(ACTIONS), "in place": in_place}
    order = [ways[first], *ways.values(), ways[first]]
    for step in order:
        step()
    assert torch.isfinite(task.smooth).all()
    assert (task.smooth > 5 * 0.3).all()  # five steps, at some 0.5 m each


@pytest.mark.parametrize(
    "same",
    [
        lambda actions: actions.double(),
        lambda actions: actions.numpy(),
        lambda actions: actions.numpy().astype(np.float64),
        lambda actions: actions.tolist(),
        lambda actions: actions.t().contiguous().t(),
        lambda actions: actions.clone().requires_grad_(),
    ],
    ids=["float64", "array", "array of float64", "list", "strided", "leaf"],
)
def test_the_same_numbers_in_another_form_do_the_same(task, same):
    assert torch.allclose(stepped(task, same(ACTIONS)), stepped(task, ACTIONS), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.int64, torch.int8, torch.float16, torch.bfloat16])
def test_numbers_of_another_type_are_taken_as_they_are(task, dtype):
    whole = torch.ones(4, 12)
    assert torch.equal(stepped(task, whole.to(dtype)), stepped(task, whole))


@pytest.mark.parametrize(
    ("actions", "got"),
    [
        (torch.zeros(12), r"\(12,\)"),
        (torch.zeros(1, 12), r"\(1, 12\)"),
        (torch.zeros(4, 1), r"\(4, 1\)"),
        (torch.zeros(12, 4), r"\(12, 4\)"),
        (torch.zeros(4, 13), r"\(4, 13\)"),
        (torch.zeros(1, 4, 12), r"\(1, 4, 12\)"),
        (torch.tensor(0.0), r"\(\)"),
        (0.0, r"\(\)"),
        (np.zeros(12), r"\(12,\)"),
        ([], r"\(0,\)"),
        ([[0.0] * 12, [0.0] * 11], "list: expected sequence of length 12"),
        (None, "NoneType"),
        ("walk", "str"),
        ({"actions": 1}, "dict"),
        (torch.zeros(4, 12, dtype=torch.complex64), "complex64"),
        (torch.zeros(4, 12, dtype=torch.bool), "bool"),
    ],
    ids=str,
)
def test_other_shapes_are_refused_by_the_one_that_is_expected(task, actions, got):
    task.step(ACTIONS)
    before, length = task.actions.clone(), task.episode_length_buf.clone()
    with pytest.raises(ValueError, match=rf"expected real numbers of shape \(N, D\) = \(4, 12\), got .*{got}"):
        task.step(actions)
    assert torch.equal(task.actions, before)
    assert torch.equal(task.episode_length_buf, length)
