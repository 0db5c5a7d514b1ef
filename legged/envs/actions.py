"""Conversion of a caller's actions to a tensor, and a context manager for steps without gradients."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor


@contextmanager
def ordinary_tensors() -> Iterator[None]:
    """Run the block without gradients, and outside torch's inference mode even if the caller has switched that mode on. A
    term may keep a tensor between steps, and a later step could not write to a tensor that was made in inference mode.
    """
    with torch.inference_mode(False), torch.no_grad():
        yield


def as_actions(actions: Any, num_envs: int, num_actions: int) -> Tensor:
    """Return `actions` as a tensor (N, D) of real numbers.

    Raises:
        ValueError: the actions are not real numbers, or have another shape.
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
