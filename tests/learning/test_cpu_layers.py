"""What makes an update fast on a CPU, and the same with any number of threads: layers of our own, and another library for
products of matrices.
"""

from dataclasses import replace

import pytest
import torch
from helpers import small_config

from legged.learning.cpu_layers import Affine, ExponentialUnit, apply_layers
from legged.learning.networks import use_matmul


def test_the_activation_and_its_gradient_are_those_of_torch():
    x = torch.cat([torch.linspace(-100.0, 100.0, 4001), torch.tensor([0.0, -1e-8, 1e-8, -torch.inf, torch.inf])])
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    y, true = ExponentialUnit.apply(ours), torch.nn.functional.elu(theirs)
    torch.testing.assert_close(y, true, atol=1.2e-7, rtol=0.0)
    weights = torch.randn(len(x), generator=torch.Generator().manual_seed(0))
    y.backward(weights)
    true.backward(weights)
    torch.testing.assert_close(ours.grad, theirs.grad, atol=1e-6, rtol=0.0)


def test_the_gradient_of_the_activation_is_its_slope():
    x = torch.tensor([-30.0, -3.0, -0.5, -1e-3, 1e-3, 0.7, 20.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(ExponentialUnit.apply, (x,))


def test_the_activation_lets_what_is_no_number_through():
    assert ExponentialUnit.apply(torch.tensor([torch.nan, 1.0])).isnan().tolist() == [True, False]


@pytest.mark.parametrize("matmul", ["tf32", "float32"])
def test_matrices_are_multiplied_in_float32_on_a_cpu(matmul):
    """Rounded to bfloat16, the products of 300 numbers of size 1 would be off by some 0.05, in TF32 by 0.01."""
    cfg = small_config()
    use_matmul(replace(cfg, train=replace(cfg.train, runner=replace(cfg.train.runner, matmul=matmul))))
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.randn(300, 300, generator=generator) for _ in range(2))
    torch.testing.assert_close((a @ b).double(), a.double() @ b.double(), atol=2e-4, rtol=0.0)


@pytest.mark.parametrize("rows", [3, 8, 21])
def test_the_gradients_of_a_linear_layer_are_its_slopes(rows):
    generator = torch.Generator().manual_seed(rows)
    factors = [torch.randn(*size, generator=generator, dtype=torch.float64) for size in ((rows, 5), (4, 5), (4,))]
    assert torch.autograd.gradcheck(Affine.apply, [factor.requires_grad_() for factor in factors])


def test_layers_are_those_of_torch():
    torch.manual_seed(0)
    layers = torch.nn.Sequential(
        torch.nn.Linear(6, 5), torch.nn.ELU(), torch.nn.Linear(5, 4, bias=False), torch.nn.Tanh(), torch.nn.Linear(4, 2)
    )
    x = torch.randn(19, 6)
    found = []
    for apply in (layers, lambda x: apply_layers(layers, x)):
        y = apply(x)
        found.append([y, *torch.autograd.grad(y.square().mean(), list(layers.parameters()))])
    for theirs, ours in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-5)
