"""Closed forms of gradients agree with autograd."""

import math

import pytest
import torch
from torch import nn

from legged.learning import closed_form
from legged.learning.ppo import gaussian_log_prob


def test_an_mlp_and_its_gradients():
    torch.manual_seed(0)
    layers = nn.Sequential(nn.Linear(5, 8), nn.ELU(), nn.Linear(8, 4), nn.ELU(), nn.Linear(4, 2)).double()
    x, weights = torch.randn(9, 5).double(), torch.randn(9, 2).double()
    y = layers(x)
    with torch.no_grad():
        values, slopes = closed_form.forward(layers, x)
        found = closed_form.backward(layers, values, slopes, weights)
    torch.testing.assert_close(values[-1], y)
    for ours, theirs in zip(found, torch.autograd.grad(y, layers.parameters(), weights), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_the_activation_holds_for_all_numbers():
    """Far below 0 it is -1, and it keeps NaN."""
    layers = nn.Sequential(nn.Linear(1, 1), nn.ELU(), nn.Linear(1, 1)).requires_grad_(False)
    for layer in layers[::2]:
        layer.weight.fill_(1.0)
        layer.bias.zero_()
    x = torch.tensor([[-100.0], [-1.0], [0.0], [2.0], [torch.inf], [torch.nan]])
    found = closed_form.forward(layers, x)[0][-1].flatten().tolist()
    assert found[:5] == pytest.approx([-1.0, math.exp(-1.0) - 1.0, 0.0, 2.0, math.inf])
    assert math.isnan(found[5])


@pytest.mark.parametrize(
    ("layers", "fits"),
    [
        ([nn.Linear(2, 3), nn.ELU(), nn.Linear(3, 1)], True),
        ([nn.Linear(2, 1)], True),
        ([nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1)], False),
        ([nn.Linear(2, 3), nn.ELU(alpha=0.5), nn.Linear(3, 1)], False),
        ([nn.Linear(2, 3), nn.ELU(), nn.Linear(3, 1, bias=False)], False),
    ],
)
def test_layers_with_a_closed_form_are_known(layers, fits):
    assert closed_form.fits(nn.Sequential(*layers)) == fits


@pytest.mark.parametrize("clip", [0.05, 0.2, 10.0])
def test_the_surrogate_loss(clip):
    torch.manual_seed(1)
    mean, std = torch.randn(64, 3).double().requires_grad_(), torch.tensor([0.05, 0.5, 2.0]).double().requires_grad_()
    actions = (mean + std * torch.randn(64, 3)).detach()
    old = gaussian_log_prob(actions, mean.detach() + 0.02, std.detach())
    advantages = torch.randn(64).double()
    ratio = (gaussian_log_prob(actions, mean, std) - old).exp()
    loss = torch.max(-advantages * ratio, -advantages * ratio.clamp(1.0 - clip, 1.0 + clip))
    by_mean, by_std = torch.autograd.grad(loss.sum(), (mean, std))
    with torch.no_grad():
        found = closed_form.surrogate_loss(mean, std, actions, old, advantages, clip)
    for ours, theirs in zip(found, (loss, by_mean, by_std), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("clip", [None, 0.2])
def test_the_value_loss(clip):
    torch.manual_seed(2)
    values, returns, old = (torch.randn(64).double() for _ in range(3))
    values.requires_grad_()
    loss = (values - returns).square()
    if clip is not None:
        loss = torch.max(loss, (old + (values - old).clamp(-clip, clip) - returns).square())
    (gradient,) = torch.autograd.grad(loss.sum(), values)
    for ours, theirs in zip(closed_form.value_loss(values.detach(), returns, old, clip), (loss, gradient), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_numbers_that_are_not_finite_reach_the_gradient():
    """So that the mini-batch is left out."""
    nan = torch.tensor([torch.nan, 0.0])
    zero = torch.zeros(2)
    _, gradient = closed_form.value_loss(nan, zero, zero, 0.2)
    assert gradient.isnan().tolist() == [True, False]
    _, by_mean, by_std = closed_form.surrogate_loss(
        nan.unsqueeze(1), torch.ones(1), zero.unsqueeze(1), zero, torch.ones(2), 0.2
    )
    assert by_mean.isnan().flatten().tolist() == [True, False]
    assert by_std.isnan().all()
