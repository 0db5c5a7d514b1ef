"""Numbers that are tensors, as indices: what the guard makes of them picks what torch would."""

import random
from typing import Any

import torch

from legged.graph.constants import Constants

KINDS = (torch.int64, torch.int32, torch.int16, torch.int8)
CASES = 1500


def drawn(shape: tuple[int, ...]) -> tuple[Any, ...]:
    """An index of slices, numbers, tensors of a number, lists, masks, new dimensions and an ellipsis."""
    parts: list[Any] = []
    dims = 0
    while dims < len(shape) and random.random() < 0.85:
        behind = any(part is Ellipsis for part in parts)
        kind = random.choice(("tensor", "slice", "list", "mask", "number", "new", "rest"))
        if kind == "new" or (kind in ("rest", "mask") and behind):
            parts.append(None)
            continue
        dims += kind != "rest"
        number, rows = random.randint(-2, 1), range(2 if behind else shape[dims - 1])
        parts.append(
            {
                "tensor": torch.tensor(number, dtype=random.choice(KINDS)),
                "slice": slice(random.choice((None, 1)), None),
                "list": random.choice(([0, 1], [1, 0])),
                "mask": torch.tensor([row == 0 for row in rows]),
                "number": number,
                "rest": Ellipsis,
            }[kind]
        )
    return tuple(parts)


def test_an_index_with_numbers_that_are_tensors_picks_the_same():
    random.seed(0)
    values = torch.arange(2 * 3 * 4 * 5).view(2, 3, 4, 5)
    constants, compared = Constants(), 0
    for _ in range(CASES):
        index = drawn(tuple(values.shape))
        try:
            expected = values[index]
        except (IndexError, TypeError):  # lists and masks that do not go together
            continue
        tensor, rest = constants.pick(values, index)
        assert torch.equal(tensor[rest], expected), index
        compared += any(isinstance(part, torch.Tensor) and part.dim() == 0 for part in index)
    assert compared > CASES // 4
