"""Checkpoint files: written whole or not at all, and checked before anything is built from them."""

from pathlib import Path
from typing import Any

import torch

from legged.config import TaskConfig
from legged.envs import BaseTask
from legged.errors import ConfigError
from legged.paths import relative, replacing
from legged.rl.recurrent import check_rnn


def write_checkpoint(path: Path, saved: dict[str, Any]) -> None:
    """Write a checkpoint that is whole or not there."""
    with replacing(path) as part:
        torch.save(saved, part)


def read_checkpoint(path: Path, device: str = "cpu") -> dict[str, Any]:
    """The content of a checkpoint.

    Raises:
        ConfigError: the file is missing, or is no checkpoint of rsl-rl.
    """
    try:
        saved = torch.load(path, weights_only=False, map_location=device)
    except Exception as error:  # torch raises half a dozen kinds for files that are none of its own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{relative(path)}: not a checkpoint ({reason})") from error
    if not isinstance(saved, dict) or not {"actor_state_dict", "critic_state_dict", "iter"} <= saved.keys():
        raise ConfigError(f"{relative(path)}: not a checkpoint of rsl-rl (no actor, critic and iteration in it)")
    return saved


def layer_shapes(state: dict[str, Any]) -> list[tuple[int, ...]]:
    """Shapes of a network's weight matrices, from input to output; recurrent layers aside."""
    return [tuple(tensor.shape) for name, tensor in state.items() if tensor.dim() == 2 and not name.startswith("rnn.")]


def observation_layout(task: BaseTask) -> dict[str, dict[str, int]]:
    """Group -> term -> width, kept in checkpoints."""
    return {
        name: {term.name: term.columns.stop - term.columns.start for term in group.terms}
        for name, group in task.observation_groups.items()
    }


def check_fits(path: Path, saved: dict[str, Any], cfg: TaskConfig) -> None:
    """Compare a checkpoint with a configuration, before the task is built.

    Raises:
        ConfigError: it was made for other observations, or for networks of another size.
    """
    check_rnn(path, saved, cfg)
    layout: dict[str, dict[str, int]] = (saved.get("infos") or {}).get("observations", {})
    for group, hidden in (("actor", cfg.train.policy.actor_hidden_dims), ("critic", cfg.train.policy.critic_hidden_dims)):
        shapes = layer_shapes(saved[f"{group}_state_dict"])
        wanted = tuple(getattr(cfg.observations, group))
        if group in layout and tuple(layout[group]) != wanted:
            known = {term: width for terms in layout.values() for term, width in terms.items()}
            size = sum(known[term] for term in wanted) if set(wanted) <= set(known) else "other"
            raise ConfigError(
                f"{relative(path)}: made for other observations: its {group} takes {shapes[0][1]} numbers"
                f" ({', '.join(layout[group])}), '{cfg.task}' gives {size} ({', '.join(wanted)})"
            )
        if tuple(shape[0] for shape in shapes[:-1]) != tuple(hidden):
            found = [shape[0] for shape in shapes[:-1]]
            raise ConfigError(
                f"{relative(path)}: its {group} has hidden layers {found}, the configuration"
                f" train.policy.{group}_hidden_dims {list(hidden)}"
            )


def describe_mismatch(path: Path, saved: dict[str, Any], wanted: dict[str, Any], task: str) -> str:
    """What differs between a checkpoint's policy and the one that the built task needs."""
    found, needed = layer_shapes(saved["actor_state_dict"]), layer_shapes(wanted)
    text = f"{relative(path)}: made for another task than '{task}'"
    if found and needed and found[0][1] != needed[0][1]:
        return f"{text}: its policy takes {found[0][1]} observations, the task gives {needed[0][1]}"
    return f"{text}: its policy has layers {found}, the task's {needed}"
