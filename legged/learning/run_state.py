"""Part of a training's state that is not in the checkpoint: random generators, robots, episodes. With this state a resumed
training continues as if it had never stopped. Without this state, robots start anew.

The state's size grows with the number of robots, so only the newest state is kept: state_<iteration>.pt next to
model_<iteration>.pt.
"""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from legged.config import TaskConfig, to_dict
from legged.config.dotted import differences
from legged.errors import ConfigError
from legged.learning.checkpoint import load_plain, write_checkpoint
from legged.process.paths import relative
from legged.state import StateError

FORMAT = 2
STATE_SETTINGS = (
    "terrain",
    "domain_rand",
    "init_state",
    "control",
    "commands.curriculum",
    "motion.files",
    "motion.csv_fps",
    "motion.bin_s",
    "rewards.soft_dof_pos_limit",
    "rewards.soft_dof_vel_limit",
    "env.seed",
    "env.num_envs",
)
"""Settings whose effects are stored in the state. If one of them changes, the robots can't continue from the state, because
the state depends on the old value."""


def state_path(checkpoint: Path) -> Path:
    """Return the path of a checkpoint's state file, which need not exist."""
    return checkpoint.with_name(checkpoint.name.replace("model", "state", 1))


def write_run_state(checkpoint: Path, state: dict[str, Any]) -> None:
    """Write the state of a checkpoint. Call this before the checkpoint is written, so that the newest checkpoint always has a
    state.
    """
    write_checkpoint(state_path(checkpoint), {"format": FORMAT, **state})


def remove_older(checkpoint: Path) -> None:
    """Remove the states of all checkpoints in the folder except `checkpoint`."""
    for path in checkpoint.parent.glob("state_*.pt"):
        if path != state_path(checkpoint):
            path.unlink(missing_ok=True)


def read_run_state(checkpoint: Path, checkpoint_id: str) -> dict[str, Any]:
    """Read the state of a checkpoint. The state's `id` must be `checkpoint_id`.

    Raises:
        StateError: there is no state, or it can't be used.
    """
    path = state_path(checkpoint)
    if not path.is_file():
        raise StateError(f"there is no {path.name} next to the checkpoint")
    try:
        state = load_plain(path)
    except ConfigError as error:
        raise StateError(str(error)) from error
    kinds = {"format": int, "id": str, "task": dict, "episodes": dict, "generators": dict}
    if not isinstance(state, dict) or not all(isinstance(state.get(name), kind) for name, kind in kinds.items()):
        raise StateError(f"{relative(path)} is damaged")
    if state["format"] != FORMAT:
        raise StateError(f"{relative(path)} has format {state['format']}, but this version reads format {FORMAT}")
    if state["id"] != checkpoint_id:
        raise StateError(f"{relative(path)} belongs to another checkpoint")
    return state


def check_same_world(before: TaskConfig, after: TaskConfig) -> None:
    """Check that the robots of a run can continue from their state under the configuration `after`.

    Raises:
        StateError: one of `STATE_SETTINGS` has changed.
    """
    for name, (was, now) in differences([to_dict(before), to_dict(after)]).items():
        if any(name == path or name.startswith(f"{path}.") for path in STATE_SETTINGS):
            raise StateError(f"{name} was {was}, and is {now} now")


def generators() -> dict[str, Any]:
    """Return the state of every random generator of this process, as plain data."""
    version, numbers, gauss = random.getstate()
    name, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    assert isinstance(keys, np.ndarray)
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state() if torch.cuda.is_available() else None,
        "python": [version, list(numbers), gauss],
        "numpy": [name, torch.from_numpy(keys.astype(np.int64)), int(position), int(has_gauss), float(cached)],
    }


def set_generators(state: dict[str, Any]) -> None:
    """Restore the random generators. The state of a GPU's generator is skipped if this machine has no GPU.

    Raises:
        StateError: the states are damaged.
    """
    try:
        version, numbers, gauss = state["python"]
        name, keys, position, has_gauss, cached = state["numpy"]
        random.setstate((version, tuple(numbers), gauss))
        np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, cached))
        torch.set_rng_state(state["torch"])
        if isinstance(state["cuda"], Tensor) and torch.cuda.is_available():
            torch.cuda.set_rng_state(state["cuda"])
    except Exception as error:  # each generator raises its own error types for a wrong state
        raise StateError(f"the state of the random generators is damaged ({error})") from error


@contextmanager
def kept_generators(device: torch.device) -> Iterator[None]:
    """Restore the random generators of this process after the block: those of the host and, if `device` is a GPU, of every
    GPU.
    """
    python, of_numpy = random.getstate(), np.random.get_state()
    gpus = range(torch.cuda.device_count()) if device.type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=gpus):
            yield
    finally:
        random.setstate(python)
        np.random.set_state(of_numpy)
