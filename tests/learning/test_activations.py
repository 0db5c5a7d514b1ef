"""What makes an update fast on a CPU: an activation of our own, and another library for products of matrices."""

from dataclasses import replace

import pytest
import torch
from helpers import small_config

from legged.learning.activations import ExponentialUnit
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
