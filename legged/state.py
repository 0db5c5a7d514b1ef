"""Saving and loading of an object's state. The state consists of the tensors that are listed in `STATE` of the class."""

from collections.abc import Iterable, Mapping
from typing import Any

from torch import Tensor


class StateError(ValueError):
    """A saved state does not fit the object that should load it."""


def state_of(owner: Any) -> dict[str, Tensor]:
    """Return copies of the tensors that `owner.STATE` names."""
    return {name: getattr(owner, name).clone() for name in owner.STATE}


def load_state(owner: Any, state: Mapping[str, Any]) -> None:
    """Copy a `state` (from `state_of`) into the tensors that `owner.STATE` names. The values may be on any device.

    Raises:
        StateError: a tensor is missing, or has another shape or type.
    """
    take({name: getattr(owner, name) for name in owner.STATE}, state, type(owner).__name__)


def take(tensors: Mapping[str, Tensor], saved: Mapping[str, Any], of: str) -> None:
    """Copy `saved` values into `tensors` of the same names. `of` is the owner's name, for error messages.

    Raises:
        StateError: a tensor is missing, or has another shape or type. In this case no tensor is copied.
    """
    for name, tensor in tensors.items():
        value = saved.get(name) if isinstance(saved, Mapping) else None
        if not isinstance(value, Tensor):
            raise StateError(f"{of}.{name} is missing")
        if value.shape != tensor.shape or value.dtype != tensor.dtype:
            found, wanted = (f"{tuple(t.shape)} {str(t.dtype).removeprefix('torch.')}" for t in (value, tensor))
            raise StateError(f"{of}.{name} is {found}, not {wanted}")
    for name, tensor in tensors.items():
        tensor.copy_(saved[name])


def tensors_of(owner: Any) -> dict[str, Tensor]:
    """Return the attributes of an object that are tensors, by name. None has no attributes."""
    return {} if owner is None else {name: value for name, value in vars(owner).items() if isinstance(value, Tensor)}


def without_memory_of(others: Iterable[Tensor], tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the `tensors` that share no memory with any of the `others`."""
    known = {tensor.untyped_storage().data_ptr() for tensor in others}
    return {name: tensor for name, tensor in tensors.items() if tensor.untyped_storage().data_ptr() not in known}
