"""Finding a trained policy and putting it back into its task."""

import argparse
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from legged.commandline.arguments import overrides
from legged.config import TaskConfig, override
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.run_folder import CONFIG_FILE, find_checkpoint, find_run, run_config, shipped_policy
from legged.policies.actor import Actor
from legged.process.paths import exists, relative
from legged.registry import YAML_ENDINGS, make_task, register_file, task_class, task_config, task_names
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
        """Return the default folder for output about the policy: the run folder, or logs/<what>/<task> for a shipped policy,
        whose folder belongs to the package and may not be writable.
        """
        return Path("logs") / what / self.folder.name if self.folder.parent.name == "policies" else self.folder


def find_policy(args: argparse.Namespace) -> TrainedPolicy:
    """Return the policy of --task, --load_run and --checkpoint; by default the newest run of the task, or the shipped policy.

    Raises:
        ConfigError: there is no such policy, or it has another task.
    """
    flags = [(key, value) for key, value in overrides(args) if key == "train.runner.experiment_name"]
    task = task_config(args.task, flags)
    folder = _newest(task) if args.load_run is None and args.checkpoint is None else find_run(task, args.load_run)
    cfg = run_config(folder)
    if cfg.task != args.task:
        raise ConfigError(f"--load_run: {relative(folder)} was trained on '{cfg.task}', not on '{args.task}'")
    return TrainedPolicy(cfg, find_checkpoint(folder, args.checkpoint))


def policy_of(name: str, where: str = "--task") -> TrainedPolicy:
    """Return the policy of a run folder, of a shipped policy's folder, or of a task, named or in a YAML file; a task stands
    for its newest run or else its shipped policy. `where` begins errors about the name.

    Raises:
        ConfigError: there is no such policy, or its task is user-defined and not registered.
    """
    folder = Path(name)
    if not exists(folder / CONFIG_FILE):
        try:
            task = task_config(register_file(name) if name.endswith(YAML_ENDINGS) else name)
        except ConfigError as error:
            raise ConfigError(str(error).replace("--task:", f"{where}:", 1)) from error
        try:
            folder = _newest(task)
        except ConfigError as error:
            raise ConfigError(
                f"'{name}': there is neither a run nor a shipped policy of this task; train one first"
            ) from error
    cfg = run_config(folder)
    if cfg.task not in task_names():  # a run does not record the file or the class of its task
        raise ConfigError(
            f"{where}: {relative(folder)} was trained on a task of your own, '{cfg.task}': name the YAML file of the task,"
            " whose newest run is taken, or import the module that registers it"
        )
    return TrainedPolicy(cfg, find_checkpoint(folder, None))


def _newest(task: TaskConfig) -> Path:
    """Return the folder of a task's newest run, or else of its shipped policy.

    Raises:
        ConfigError: the task has neither.
    """
    try:
        return find_run(task, None)
    except ConfigError:
        folder = shipped_policy(task.task)
        if folder is None:
            raise
        return folder


def undisturbed(num_envs: int, seconds: float) -> list[tuple[str, Any]]:
    """Return overrides for measuring: no noise, pushes or curriculum, friction 1, nominal mass, and long episodes."""
    return [
        ("env.num_envs", num_envs),
        ("env.episode_length_s", seconds + 10.0),
        ("observations.add_noise", False),
        ("domain_rand.randomize_friction", False),
        ("domain_rand.randomize_base_mass", False),
        ("domain_rand.push_robots", False),
        ("commands.curriculum.enabled", False),
    ]


def nominal(cfg: TaskConfig, changes: Iterable[tuple[str, Any]]) -> TaskConfig:
    """Return a configuration for measurements with the nominal model, randomised only by `changes`.

    Raises:
        ConfigError: the changes do not fit the configuration.
    """
    few_robots_do = ("train.algorithm.num_mini_batches", 1)  # nothing is trained
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
    """Return the policy's task with changed settings, on its own terrain or the given one, and the policy. Writes no files.
    `make` builds a task from a configuration, as `make_task` does.

    Raises:
        ConfigError: the checkpoint does not fit the task.
    """
    cfg = nominal(policy.cfg, changes)
    check_fits(policy.checkpoint, read_checkpoint(policy.checkpoint), cfg)
    task = make(cfg, device, graph, terrain)
    actor = Actor(task, device)
    actor.load(policy.checkpoint)
    return task, actor
