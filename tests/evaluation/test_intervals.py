"""Intervals of 95 %, against published numbers and numbers worked by hand."""

import numpy as np
import pytest

from legged.evaluation.intervals import bootstrap_mean, newcombe, normal_mean, welch, wilson


def test_the_difference_of_two_shares_has_newcombes_interval():
    """56 of 70 and 48 of 80, the first example of R. G. Newcombe 1998: 0.0524 to 0.3339 by his method 10."""
    assert newcombe((48, 80), (56, 70)) == pytest.approx((0.0524, 0.3339), abs=5e-5)
    low, high = newcombe((56, 70), (48, 80))
    assert (low, high) == pytest.approx((-0.3339, -0.0524), abs=5e-5)


def test_nothing_against_nothing_is_sure_only_up_to_the_numbers():
    low, high = newcombe((0, 100), (0, 100))
    assert high == pytest.approx(wilson(0, 100)[1])
    assert low == -high


def test_means_have_the_normal_distributions_interval():
    """1.96 standard errors: std 10 over 400 values is 0.5, with std 24 over 576 as the other mean sqrt(0.25 + 1)."""
    assert normal_mean(7.0, 10.0, 400) == pytest.approx((7.0 - 0.98, 7.0 + 0.98), abs=1e-4)
    half = 1.959964 * np.sqrt(1.25)
    assert welch((7.0, 10.0, 400), (10.0, 24.0, 576)) == pytest.approx((3.0 - half, 3.0 + half))


def test_a_bootstrap_comes_near_the_normal_interval_and_is_the_same_every_time():
    values = np.random.default_rng(3).normal(5.0, 2.0, 500)
    low, high = bootstrap_mean(values)
    assert (low, high) == bootstrap_mean(values)
    wanted = normal_mean(float(values.mean()), float(values.std()), 500)
    assert (low, high) == pytest.approx(wanted, abs=0.03)
    assert bootstrap_mean([0.25] * 9) == (0.25, 0.25)


def test_one_value_has_no_interval():
    assert normal_mean(7.0, 0.0, 1) is None
    assert welch((7.0, 1.0, 50), (9.0, 0.0, 1)) is None
    assert bootstrap_mean([0.25]) is None
