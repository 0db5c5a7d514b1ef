"""Transfer of networks from another training, for `legged train --transfer`."""

from collections.abc import Iterable, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any

from legged.config import TaskConfig
from legged.config.networks import groups_of, learns_from_teacher
from legged.envs import BaseTask
from legged.errors import ConfigError
from legged.learning.checkpoint import (
    Saved,
    check_joints,
    check_networks_fit,
    networks_in,
    observation_layout,
    read_checkpoint,
)
from legged.learning.networks import action_std
from legged.learning.run_folder import find_checkpoint, run_named
from legged.process.paths import relative
from legged.registry import task_config

OPTIMIZERS = {"adam": "Adam", "adamw": "AdamW", "sgd": "SGD", "rmsprop": "RMSprop"}
"""Optimiser's name in a configuration -> name in torch."""

Terms = dict[str, int | None]
"""Terms of an observation group, in order: name -> width, or None if unknown."""


def transferred(
    task: str, overrides: Iterable[tuple[str, Any]], source: str, iteration: int | str | None, on_cpu: bool
) -> tuple[TaskConfig, Path]:
    """Return the configuration of a training of `task`, and the checkpoint to begin with. `source` names a run or policy;
    `iteration` is a number, 'best', or None for the latest.

    The checkpoint is compared with the configuration as far as possible without building the task.

    Raises:
        ConfigError: there is no such run, or its robot, observations or networks differ.
    """
    cfg = task_config(task, overrides, on_cpu)
    if learns_from_teacher(cfg):
        raise ConfigError(f"--transfer: '{cfg.task}' learns from a teacher, and can't begin with a policy; use --teacher")
    path = find_checkpoint(run_named(source, "--transfer"), iteration)
    check_source(path, read_checkpoint(path), cfg)
    return cfg, path


def check_source(path: Path, saved: Saved, cfg: TaskConfig) -> None:
    """Compare a checkpoint with the configuration of another task, as far as possible without building that task.

    Raises:
        ConfigError: the robot, observations or networks differ.
    """
    saved, infos = transferable_parts(saved, cfg), saved["infos"]
    if "critic_state_dict" not in saved and not cfg.train.algorithm.critic_warmup_iterations:
        raise ConfigError(
            f"{relative(path)}: holds a policy without a value function, so a training can't begin with it"
            "; train.algorithm.critic_warmup_iterations=50 trains a new value function first"
        )
    check_joints(relative(path), infos.get("robot", {}), cfg)
    there = infos["observations"]
    widths = {term: width for terms in there.values() for term, width in terms.items()}
    here = {name: dict.fromkeys(group.terms) for name, group in cfg.observations.groups.items()}
    here = {name: {term: widths.get(term) for term in terms} for name, terms in here.items()}
    steps = {name: group.history for name, group in cfg.observations.groups.items()}
    _check_observations(path, cfg, here, there, steps, infos["histories"], networks_in(saved))
    check_networks_fit(relative(path), saved, cfg)


def transferable_parts(saved: Saved, cfg: TaskConfig) -> Saved:
    """Return the parts of a checkpoint that a training of `cfg` begins with: all parts, or only the policy if a new value
    function is to be trained first.
    """
    if not cfg.train.algorithm.critic_warmup_iterations:
        return saved
    infos = {name: said for name, said in saved["infos"].items() if name != "learning_rate"}
    return {"actor_state_dict": saved["actor_state_dict"], "iter": saved["iter"], "infos": infos}


def check_built(path: Path, saved: Saved, task: BaseTask) -> None:
    """Compare the observations and actions of a built task, including their widths, with those of a checkpoint.

    Raises:
        ConfigError: the observations or the actions differ.
    """
    cfg = task.cfg
    here: dict[str, Terms] = {name: {**terms} for name, terms in observation_layout(task).items()}
    steps = {name: group.history for name, group in task.observation_groups.items()}
    there = saved["infos"]
    _check_observations(path, cfg, here, there["observations"], steps, there["histories"], networks_in(saved))
    layers = [name for name in saved["actor_state_dict"] if name.startswith("mlp.") and name.endswith(".bias")]
    outputs = (*saved["actor_state_dict"][layers[-1]].shape, 0)[0] if layers else 0
    found = outputs // 2 if cfg.train.policy.state_dependent_std else outputs
    if found != task.num_actions:
        raise ConfigError(f"{relative(path)}: its policy gives {found} actions, but '{cfg.task}' takes {task.num_actions}")


def _check_observations(
    path: Path,
    cfg: TaskConfig,
    here: Mapping[str, Terms],
    there: Mapping[str, Terms],
    steps_here: Mapping[str, int],
    steps_there: Mapping[str, int],
    networks: Iterable[str],
) -> None:
    """Compare term by term the observation groups that `networks` read: the task's (`here`) and the checkpoint's (`there`).

    Raises:
        ConfigError: groups differ. The text gives the first difference of each group.
    """
    differences = []
    for name in dict.fromkeys(group for network in networks for group in groups_of(cfg, network)):
        difference = first_difference(here[name], there.get(name, {}))
        history, before = steps_here[name], steps_there.get(name, 1)
        if difference:
            differences.append(f"{name}: {difference}")
        elif history != before:
            differences.append(f"{name}: holds the last {history} observations here, the last {before} there")
    if differences:
        raise ConfigError(f"{relative(path)}: made for other observations than '{cfg.task}': {'; '.join(differences)}")


def first_difference(here: Terms, there: Terms) -> str:
    """Return the first difference between the terms of two groups, in name, place or width; empty if they are equal."""
    for number, (mine, theirs) in enumerate(zip_longest(here.items(), there.items()), 1):
        if mine is None or theirs is None or mine[0] != theirs[0] or (None not in (mine[1], theirs[1]) and mine != theirs):
            return f"term {number} is {_shown(mine)} here, {_shown(theirs)} there"
    return ""


def _shown(term: tuple[str, int | None] | None) -> str:
    """Return the text for a term in an error: its name and width, such as 'heights' (187)."""
    if term is None:
        return "none"
    name, width = term
    return f"'{name}'" if width is None else f"'{name}' ({width})"


def transfer_summary(path: Path, saved: Saved, actor: Any, cfg: TaskConfig, learning_rate: float) -> str:
    """Return two lines of text: the parts that were taken from a checkpoint, and the parts that begin anew."""
    sizes = [_sizes(saved["infos"]["networks"][network]) for network in networks_in(saved)]
    alone = len(sizes) == 1
    networks = f"actor and critic {sizes[0]}" if len({*sizes}) == 1 else f"actor {sizes[0]} and critic {sizes[-1]}"
    networks = f"actor {sizes[0]}" if alone else networks
    taken = [networks]
    if cfg.train.policy.obs_normalization:
        taken.append("observation normaliser")
    ours, theirs = cfg.train.algorithm.optimizer, saved["infos"]["optimizer"]
    if alone:
        warmup = cfg.train.algorithm.critic_warmup_iterations
        first = f"the value function is new and learns alone for {warmup} iterations"
        with_std = "" if cfg.train.policy.state_dependent_std else f"; the std begins at {cfg.train.policy.init_noise_std:g}"
        anew = f"optimiser, iterations, curricula and robots begin anew{with_std}"
        return f"{_from(path, saved)}: {', '.join(taken)}\n{first}; {anew}"
    if "optimizer_state_dict" in saved and ours == theirs:
        taken.append(f"{OPTIMIZERS[ours]}'s state")
    else:
        why = "not in the checkpoint" if ours == theirs else f"the checkpoint's optimiser is {OPTIMIZERS.get(theirs, theirs)}"
        taken.append(f"no state of {OPTIMIZERS[ours]} ({why})")
    fixed = " (fixed, the configuration's)" if cfg.train.algorithm.schedule == "fixed" else ""
    taken.append(f"learning rate {learning_rate:.2g}{fixed}")
    anew = "iterations, curricula and robots begin anew"
    if not cfg.train.policy.state_dependent_std:
        std = action_std(actor).detach()
        taken.append(f"std {float(std.min()):.2f} to {float(std.max()):.2f}")
        anew += "; the std is the learned one, not train.policy.init_noise_std"
    return f"{_from(path, saved)}: {', '.join(taken)}\n{anew}"


def _from(path: Path, saved: Saved) -> str:
    """Return a text that names the source checkpoint."""
    task = saved["infos"].get("task", "no task named")
    return f"took from {relative(path.parent)} ({task}, iteration {saved['iter']})"


def _sizes(network: Mapping[str, Any]) -> str:
    """Return the widths of a network's layers, such as (128, 64), or (lstm 256, 128, 64) with a recurrent layer."""
    kind = network.get("rnn_type", "none")
    recurrent = [] if kind == "none" else [f"{kind} {network['rnn_hidden_dim']}"] * network["rnn_num_layers"]
    return f"({', '.join([*recurrent, *map(str, network['hidden_dims'])])})"
