"""Distributions by their properties: range, mean, mean logarithm, spread, and how ranges grow."""

import math

import pytest
import torch

from legged.config.randomization import DrawConfig
from legged.mdp.distributions import Distributions

CPU = torch.device("cpu")
MANY = 40_000


def drawn(*columns: DrawConfig) -> torch.Tensor:
    torch.manual_seed(5)
    return Distributions(columns, [0.0] * len(columns), CPU).at_once(MANY)


def test_uniform_numbers_fill_their_range_evenly():
    values = drawn(DrawConfig((-1.0, 3.0)))[:, 0]
    assert (values >= -1.0).all()
    assert (values <= 3.0).all()
    assert values.mean() == pytest.approx(1.0, abs=0.03)
    assert values.var() == pytest.approx(16.0 / 12.0, rel=0.03)


def test_logarithms_of_log_uniform_numbers_fill_their_range_evenly():
    """From 0.1 to 10 half of the numbers are below 1, and the mean is (10 - 0.1) / ln 100 = 2.15."""
    values = drawn(DrawConfig((0.1, 10.0), distribution="log_uniform"))[:, 0]
    assert (values >= 0.1).all()
    assert (values <= 10.0).all()
    assert values.log().mean() == pytest.approx(0.0, abs=0.03)
    assert (values < 1.0).float().mean() == pytest.approx(0.5, abs=0.01)
    assert values.mean() == pytest.approx(9.9 / math.log(100.0), rel=0.02)


def test_normal_numbers_are_cut_off_at_the_ends_of_their_range():
    """A quarter of the width is the standard deviation; cut off at two of them, 0.8796 of it is left (tables)."""
    values = drawn(DrawConfig((0.0, 4.0), distribution="gaussian"))[:, 0]
    assert (values >= 0.0).all()
    assert (values <= 4.0).all()
    assert values.mean() == pytest.approx(2.0, abs=0.02)
    assert values.std() == pytest.approx(0.8796, abs=0.01)
    assert ((values - 2.0).abs() < 1.0).float().mean() == pytest.approx(0.6827 / 0.9545, abs=0.01)
    assert ((values == 0.0) | (values == 4.0)).float().mean() < 1e-3  # not heaped up at the ends
    narrow = drawn(DrawConfig((0.0, 4.0), distribution="gaussian", std=0.1))[:, 0]
    assert narrow.std() == pytest.approx(0.1, abs=0.002)


def test_columns_keep_their_order_whatever_their_distributions_are():
    columns = [
        DrawConfig((1.0, 2.0), distribution="gaussian"),
        DrawConfig((3.0, 4.0)),
        DrawConfig((5.0, 6.0), distribution="log_uniform"),
        DrawConfig((7.0, 8.0), distribution="gaussian"),
        DrawConfig((9.0, 9.0), distribution="gaussian"),
    ]
    values = drawn(*columns)
    for column, draw in enumerate(columns):
        low, high = draw.range
        assert values[:, column].min() >= low
        assert values[:, column].max() <= high
    assert torch.corrcoef(values[:, :4].t()).fill_diagonal_(0.0).abs().max() < 0.03


def test_ranges_grow_from_the_neutral_value_over_their_iterations():
    """Iterations of 10 steps, from iteration 2 to 6: at step 40 half of the way has been made."""
    draws = Distributions([DrawConfig((0.5, 2.0), grow=(2.0, 6.0)), DrawConfig((0.5, 2.0))], [1.0, 1.0], CPU, 10)
    ends = torch.stack([draws.low, draws.high])
    for step, low, high in ((0, 1.0, 1.0), (20, 1.0, 1.0), (40, 0.75, 1.5), (60, 0.5, 2.0), (500, 0.5, 2.0)):
        found = draws.values(ends, torch.tensor(float(step)))
        assert found.flatten().tolist() == pytest.approx([low, 0.5, high, 2.0])


def test_a_range_without_its_neutral_value_grows_from_its_nearer_end():
    draws = Distributions([DrawConfig((2.0, 3.0), grow=(0.0, 1.0))], [1.0], CPU)
    assert draws.values(draws.high.view(1, 1), torch.tensor(0.0)).item() == 2.0
