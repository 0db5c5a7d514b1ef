"""What callers give a task: actions of any kind, with or without gradients being recorded."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor


@contextmanager
def ordinary_tensors() -> Iterator[None]:
    """Record no gradients, but make no inference tensors either, even if the caller does: what a term keeps of one step must
    be writable in the next, whoever makes that.
    """
    with torch.inference_mode(False), torch.no_grad():
        yield


def as_actions(actions: Any, num_envs: int, num_actions: int) -> Tensor:
    """Return the actions that a caller gave as a tensor (N, D) of real numbers.

    Raises:
        ValueError: they are none.
    """
    wanted = f"actions: expected real numbers of shape (N, D) = ({num_envs}, {num_actions})"
    try:
        tensor = actions if isinstance(actions, Tensor) else torch.tensor(actions)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{wanted}, got {type(actions).__name__}: {error}") from error
    if tensor.shape != (num_envs, num_actions):
        raise ValueError(f"{wanted}, got {tuple(tensor.shape)}")
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise ValueError(f"{wanted}, got {tensor.dtype}")
    return tensor
