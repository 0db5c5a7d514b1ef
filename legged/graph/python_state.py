"""Python state that a CUDA graph does not replay: attributes other than tensors, and the host's random generators."""

import random
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

LIBRARIES = ("builtins", "legged", "mujoco", "newton", "numpy", "tensordict", "torch", "warp")
"""Packages whose objects hold no state of a user's code."""


def random_states() -> dict[str, Any]:
    """Return the states of the host's two global random generators."""
    kind, keys, *rest = np.random.get_state()
    return {"np.random": (kind, np.asarray(keys).tobytes(), *rest), "Python's random": random.getstate()}


def plain_state(value: Any, depth: int = 3) -> Any:
    """Return a comparable form of a Python value.

    The value may be a number, a text, an array, a random generator, an object of a user's class, or a container of these.
    Other values, such as tensors, give None. For tensors, the guard compares the operators that read them.
    """
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        return repr(value)
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, np.random.Generator):
        return repr(value.bit_generator.state)
    if isinstance(value, np.random.RandomState):
        kind, keys, *rest = value.get_state()
        return kind, np.asarray(keys).tobytes(), *rest
    if isinstance(value, random.Random):
        return value.getstate()
    if depth == 0:
        return None
    if isinstance(value, list | tuple | deque):
        return [plain_state(part, depth - 1) for part in value]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if isinstance(value, Mapping):
        return {repr(key): plain_state(part, depth - 1) for key, part in value.items()}
    own = type(value).__module__.partition(".")[0] not in LIBRARIES
    return attributes(value, depth - 1) if own and hasattr(value, "__dict__") and not callable(value) else None


def attributes(owner: Any, depth: int = 3) -> dict[str, Any]:
    """Return the plain state of an object's attributes."""
    return {name: plain_state(value, depth) for name, value in vars(owner).items()} if hasattr(owner, "__dict__") else {}


def shown(state: Any) -> str:
    """Return a state as text, cut if it is long."""
    text = str(state)
    return text if len(text) <= 40 else f"{text[:37]}..."
