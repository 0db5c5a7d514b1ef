"""Settings and checkpoint from which `legged train --resume` continues."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from legged.config import TaskConfig, has_robot, override, to_dict
from legged.config.dotted import value_at
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, check_optimizer, digests, read_checkpoint
from legged.learning.run_folder import find_checkpoint, find_run, run_config
from legged.process.paths import relative
from legged.registry import task_class, task_config

RUN_SETTINGS = ("train.runner.run_name", "train.runner.max_iterations", "train.runner.experiment_name")
"""Settings that do not affect how the policy is trained."""

KEPT = ("train.algorithm.class_name", "train.distillation.teacher")
"""Settings that a resumed training can't change."""


def resumed(
    task: str, asked: Iterable[tuple[str, Any]], load_run: str | None, iteration: int | str | None
) -> tuple[TaskConfig, Path, list[str]]:
    """Return the configuration to continue with, the checkpoint to continue from, and what has changed: a line for each
    setting that `asked` changes, and one that names the terms whose code has changed since the checkpoint.

    `load_run` names a run of the task, or is None for the newest. `iteration` is a number, 'best', or None for the latest.
    All errors are found here, before anything is built.

    Raises:
        ConfigError: there is no such run; its task, robot, observations or networks differ; or it has finished.
    """
    asked = list(asked)
    folders = [(key, value) for key, value in asked if key == "train.runner.experiment_name"]
    folder = find_run(task_config(task, folders), load_run)
    before = run_config(folder, "--load-run")
    if before.task != task:
        raise ConfigError(f"--load-run: {relative(folder)} was trained on '{before.task}', not on '{task}'")
    cfg = override(before, asked)
    if has_robot(cfg) and has_robot(before) and cfg.robot != before.robot:
        raise cfg.origins.error("robot", f"a resumed training keeps its robot '{before.robot}'; got '{cfg.robot}'")
    for key in KEPT:
        old, new = (value_at(to_dict(one), key) for one in (before, cfg))
        if old != new:
            raise cfg.origins.error(key, f"a resumed training can't change '{old}'; got '{new}'")
    task_class(cfg.task).check(cfg)
    path = find_checkpoint(folder, iteration)
    saved = read_checkpoint(path)
    check_fits(path, saved, cfg)
    if "optimizer_state_dict" not in saved:
        raise ConfigError(f"{relative(path)}: holds no optimiser, so its training can't be resumed; the policy can be played")
    check_optimizer(path, saved, cfg)
    done, until = saved["iter"] + 1, cfg.train.runner.max_iterations
    if done >= until:
        raise ConfigError(
            f"--resume: {relative(path)} has finished {done} iterations of {until}; --max-iterations sets a larger total"
        )
    then, now = saved["infos"].get("terms", {}), digests(task_class(cfg.task), cfg)
    edited = ", ".join(method for method in now if then.get(method, now[method]) != now[method])
    lines = changes(before, cfg, (key for key, _ in asked))
    return cfg, path, [*lines, f"the code of {edited} has changed since"] if edited else lines


def changes(before: TaskConfig, after: TaskConfig, asked: Iterable[str]) -> list[str]:
    """Return a line such as 'env.seed 7 -> 3' for each of the dotted paths `asked` whose value has changed."""
    found = []
    for path in dict.fromkeys(asked):
        old, new = (value_at(to_dict(cfg), path) for cfg in (before, after))
        if old != new and path not in RUN_SETTINGS:
            found.append(f"{path} {old} -> {new}")
    return found
