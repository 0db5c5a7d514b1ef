"""Search for a trained policy, and reconstruction of its task and its actor network."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from legged.config import TaskConfig, override
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.run_folder import find_checkpoint, run_config, run_named
from legged.policies.actor import Actor
from legged.process.paths import relative
from legged.registry import make_task, task_class, task_names
from legged.terrain import Terrain


@dataclass(frozen=True)
class TrainedPolicy:
    """A checkpoint and the configuration of its training."""

    cfg: TaskConfig
    checkpoint: Path

    @property
    def folder(self) -> Path:
        """Return the run folder, or the folder of the shipped policy."""
        return self.checkpoint.parent

    def output(self, what: str) -> Path:
        """Return the default folder for output about the policy: the run folder, but logs/<what>/<task> for a shipped policy.
        A shipped policy is inside the package, whose folders can be read-only.
        """
        return Path("logs") / what / self.folder.name if self.folder.parent.name == "policies" else self.folder


def policy_of(name: str, checkpoint: int | str | None = None, where: str = "POLICY") -> TrainedPolicy:
    """Return the policy that a user names. `name` is a run `<experiment>/<run>` below logs/, a folder, or a task or its YAML
    file. For a task, take its newest run, or its shipped policy if there is no run. `checkpoint` is an iteration or 'best';
    None takes the latest checkpoint. `where` is the argument that gave the name.

    Raises:
        ConfigError: there is no such policy or checkpoint, or its task is not known.
    """
    folder = run_named(name, where)
    cfg = run_config(folder, where)
    if cfg.task not in task_names():  # a run stores neither the file nor the class of its task
        raise ConfigError(
            f"{where}: {relative(folder)} was trained on a user-defined task, '{cfg.task}'; to name the file that"
            " defines it, use --import FILE"
        )
    return TrainedPolicy(cfg, find_checkpoint(folder, checkpoint))


def undisturbed(cfg: TaskConfig, num_envs: int, seconds: float | None = None) -> list[tuple[str, Any]]:
    """Return overrides for measurements without noise, pushes and curricula, and with the model's friction and mass. If
    `seconds` is given, no episode ends by time within `seconds`; otherwise episodes are as long as in the training.
    """
    length = [] if seconds is None else [("env.episode_length_s", seconds + 10.0)]
    return [("env.num_envs", num_envs), *length, *((path, False) for path in cfg.DISTURBANCES)]


def nominal(cfg: TaskConfig, changes: Iterable[tuple[str, Any]]) -> TaskConfig:
    """Return a training's configuration for measurements. Randomisation is off, unless `changes` switch it on.

    Raises:
        ConfigError: the changes do not fit the configuration.
    """
    few_robots_do = ("train.algorithm.num_mini_batches", 1)  # `check` refuses more mini-batches than samples
    cfg = override(cfg.trained(), [*changes, few_robots_do])
    task_class(cfg.task).check(cfg)
    return cfg


def restore(
    policy: TrainedPolicy,
    changes: Iterable[tuple[str, Any]],
    device: torch.device,
    graph: bool = True,
    terrain: Terrain | None = None,
    make: Callable[..., Any] = make_task,
) -> tuple[Any, Actor]:
    """Build the policy's task with `changes`, on the task's own terrain or the given one; return the task and the policy. No
    file is written. `make` builds a task from a configuration, as `make_task` does.

    Raises:
        ConfigError: the checkpoint does not fit the task.
    """
    cfg = nominal(policy.cfg, changes)
    check_fits(policy.checkpoint, read_checkpoint(policy.checkpoint), cfg)
    task = make(cfg, device, graph, terrain)
    actor = Actor(task, device)
    actor.load(policy.checkpoint)
    return task, actor
