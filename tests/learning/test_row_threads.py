"""Gradients of chunks of a mini-batch add up to its gradient, with any number of threads."""

import pytest
import torch
from helpers import small_task
from torch import nn

from legged.learning import row_threads
from legged.learning.captured import CapturedRunner
from legged.learning.rollout import Rollout
from legged.learning.row_threads import RowThreads


@pytest.fixture(autouse=True)
def chunks(monkeypatch):
    """Chunks of at most 14 rows; no mini-batch below is a multiple."""
    monkeypatch.setattr(row_threads, "CHUNK", 14)


@pytest.mark.parametrize("threads", [None, 1, 3])
def test_chunks_add_up_to_the_mini_batch(threads):
    """Rows of `x` are followed by their images. A parameter without influence gets no gradient."""
    torch.manual_seed(0)
    layer, unused = nn.Linear(4, 3), nn.Parameter(torch.ones(2))
    x, wanted = torch.randn(2 * 40, 4), torch.randn(40, 3)

    parameters = [*layer.parameters(), unused]

    def gradients(x, wanted):
        found, image = layer(x).split(len(wanted))
        value = (found - wanted).square().mean() + (found * image).mean()
        figures = torch.stack([value, image.mean()]).detach()
        return torch.autograd.grad(value, parameters, allow_unused=True), figures

    several = RowThreads(threads)
    figures = several.backward(gradients, several.chunks((x, wanted)), parameters)
    whole, expected = gradients(x, wanted)
    torch.testing.assert_close(figures, expected)
    for parameter, gradient in zip(layer.parameters(), whole, strict=False):
        torch.testing.assert_close(parameter.grad, gradient)
    assert unused.grad is None


def test_gradients_are_added_to_those_that_are_there():
    """With several processes they are views of a shared buffer, which must stay in place."""
    weight = nn.Parameter(torch.tensor([2.0]))
    buffer = torch.tensor([10.0])
    weight.grad = buffer
    one = RowThreads(1)
    one.backward(lambda x: ([x.mean().unsqueeze(0)], x.mean().unsqueeze(0)), one.chunks((torch.arange(21.0),)), [weight])
    assert buffer.item() == pytest.approx(10.0 + 10.0)


def test_an_error_in_a_thread_reaches_the_caller():
    def fail(x):
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        RowThreads(2).backward(fail, RowThreads(2).chunks((torch.zeros(40, 1),)), [])


@pytest.mark.slow
def test_an_update_gives_the_same_numbers_with_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(row_threads, "CHUNK", 200)
    found = []
    for threads in (1, 2, 3):
        torch.manual_seed(0)
        task = small_task(("train.runner.num_steps_per_env", 24), ("sim.threads", threads), num_envs=256)
        torch.manual_seed(0)
        runner = CapturedRunner(task)
        Rollout(task, runner.alg).collect()
        runner.alg.learn(2)
        found.append([parameter.detach().clone() for parameter in runner.alg.actor.parameters()])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
