"""The random numbers of a step: even, inside the bounds of who asked, apart from each other, and always in one place."""

import pytest
import torch

from legged.mdp.random_pool import RandomPool

MANY, CPU = 20_000, torch.device("cpu")


def test_everyone_gets_numbers_between_the_bounds_asked_for():
    torch.manual_seed(0)
    numbers = RandomPool(MANY, CPU)
    one, other = numbers.between(-1.0, 3.0, 2), numbers.between([5.0, 2.0, 0.0], torch.tensor([6.0, -2.0, 0.0]), 3)
    numbers.draw()
    for drawn in (one, other):
        low, high = torch.minimum(drawn.low, drawn.high), torch.maximum(drawn.low, drawn.high)
        assert (drawn.values >= low).all()
        assert (drawn.values <= high).all()
        assert torch.allclose(drawn.values.mean(dim=0), (low + high) / 2, atol=0.05)
        assert torch.allclose(drawn.values.std(dim=0), (high - low) / 12**0.5, rtol=0.02)
    together = torch.cat([one.values, other.values[:, :2]], dim=1).t()
    assert (torch.corrcoef(together) - torch.eye(4)).abs().max() < 0.05


def test_they_are_new_at_every_draw_and_stay_where_they_are():
    numbers = RandomPool(3, CPU)
    drawn = numbers.between(0.0, 1.0, 2)
    numbers.draw()
    first, address = drawn.values.clone(), drawn.values.data_ptr()
    numbers.draw()
    assert drawn.values.data_ptr() == address
    assert not torch.isclose(drawn.values, first).any()


def test_who_asks_too_late_is_told_when_to_ask():
    numbers = RandomPool(3, CPU)
    numbers.draw()
    with pytest.raises(RuntimeError, match="_init_buffers"):
        numbers.between(0.0, 1.0, 2)
