"""Observation groups of the networks, and checks of the networks against the rest of a configuration."""

from collections.abc import Iterator
from operator import attrgetter
from typing import Any

from legged.config.mdp import ObservationGroupConfig
from legged.config.task import TaskConfig
from legged.errors import suggest

NETWORKS = ("actor", "critic")
ESTIMATED = "estimated"
"""Name of the observation group with an estimator's targets."""
TARGETS = "train.policy.estimator.targets"


def groups_of(cfg: TaskConfig, network: str) -> tuple[str, ...]:
    """Return the names of the groups that `actor` or `critic` reads, in order."""
    return getattr(cfg.train.policy, f"{network}_observations")


def groups_in(cfg: TaskConfig) -> dict[str, ObservationGroupConfig]:
    """Return all observation groups of a task: those that the configuration names, and the targets of an estimator."""
    targets = cfg.train.policy.estimator.targets
    return {**cfg.observations.groups, **({ESTIMATED: ObservationGroupConfig(targets)} if targets else {})}


def path_of_terms(cfg: TaskConfig, group: str) -> str:
    """Return the dotted path of the setting that lists the terms of an observation group."""
    is_targets = group == ESTIMATED and bool(cfg.train.policy.estimator.targets)
    return TARGETS if is_targets else f"observations.groups.{group}.terms"


def learns_from_teacher(cfg: TaskConfig) -> bool:
    """Return True if a policy is a student that learns from a teacher."""
    return cfg.train.algorithm.class_name == "Distillation"


def check_networks(cfg: TaskConfig) -> None:
    """Check that the networks fit the observations, each other and the learner.

    Raises:
        ConfigError: a network reads an unknown group; the initial standard deviation is out of bounds; a group has the name
            that is reserved for the estimator's targets; the settings of mini-batches or of distillation do not fit; or a
            setting does not work with a recurrent policy, an estimator, a student, or without one of them.
    """
    policy, algorithm, origins = cfg.train.policy, cfg.train.algorithm, cfg.origins
    known = cfg.observations.groups
    for network in NETWORKS:
        for name in groups_of(cfg, network):
            if name not in known:
                path = f"train.policy.{network}_observations"
                raise origins.error(path, f"there is no observation group '{name}'{suggest(name, known, 'groups')}")
    if not policy.min_noise_std <= policy.init_noise_std <= policy.max_noise_std:
        bounds = " and ".join(_told(cfg, f"train.policy.{name}") for name in ("min_noise_std", "max_noise_std"))
        given = policy.init_noise_std
        raise origins.error("train.policy.init_noise_std", f"must lie between {bounds}, got {given:g}")
    for path, wanted, why in _fixed_settings(cfg):
        setting = attrgetter(path)(cfg)
        if setting != wanted:
            raise origins.error(path, f"must be {_text(wanted)} {why}, got {_text(setting)}")
    if learns_from_teacher(cfg):
        length, steps = cfg.train.distillation.gradient_length, cfg.train.runner.num_steps_per_env
        if steps % length:
            nearest = min((n for n in range(1, steps + 1) if steps % n == 0), key=lambda n: abs(n - length))
            said = f"must divide {_told(cfg, 'train.runner.num_steps_per_env')}, got {length} (nearest divisor: {nearest})"
            raise origins.error("train.distillation.gradient_length", said)
        return
    if policy.estimator.targets and ESTIMATED in known:
        reserved = f"'{ESTIMATED}' is the group of the estimator's targets ({TARGETS}); rename your group"
        raise origins.error(f"observations.groups.{ESTIMATED}", reserved)
    if policy.rnn_type != "none" and algorithm.num_mini_batches > cfg.env.num_envs:
        why = f"because {_recurrent(cfg)} splits mini-batches by robot"
        said = f"must be at most env.num_envs={cfg.env.num_envs}, {why}; got {algorithm.num_mini_batches}"
        raise origins.error("train.algorithm.num_mini_batches", said)


def _fixed_settings(cfg: TaskConfig) -> Iterator[tuple[str, Any, str]]:
    """Yield the settings that can have only one value beside the other settings: dotted path, this value, and the reason."""
    policy = cfg.train.policy
    if learns_from_teacher(cfg):
        yield "train.policy.state_dependent_std", False, "because a student learns only the mean of the actions"
        yield TARGETS, (), "because a student can't train an estimator"
        return
    if policy.estimator.targets:
        why = f"with an estimator ({TARGETS}, {cfg.origins.of(TARGETS)})"
        yield "train.policy.rnn_type", "none", why
        yield "train.policy.state_dependent_std", False, why
        yield "train.algorithm.optimizer", "adam", why
        yield "train.algorithm.mirror_loss_coeff", 0, why
        yield "train.runner.loop", "captured", why
    else:
        yield "train.policy.estimator.latent", 0, f"without an estimator ({TARGETS}=[base_lin_vel] adds one)"
    if not cfg.train.algorithm.symmetry:
        why = "without mirror images (train.algorithm.symmetry=true adds them)"
        yield "train.algorithm.mirror_loss_coeff", 0, why
    if policy.rnn_type != "none":
        why = f"because {_recurrent(cfg)} can't learn from mirror images; set train.algorithm.symmetry=false"
        yield "train.algorithm.symmetry", False, why


def _text(value: Any) -> str:
    """Return a value as in YAML."""
    return str(value).lower() if isinstance(value, bool) else str(list(value)) if isinstance(value, tuple) else f"{value}"


def _told(cfg: TaskConfig, path: str) -> str:
    """Return path, value and source of a setting for errors."""
    value = attrgetter(path)(cfg)
    return f"{path}={f'{value:g}' if isinstance(value, float) else value} ({cfg.origins.of(path)})"


def _recurrent(cfg: TaskConfig) -> str:
    """Return a recurrent policy's description for errors."""
    path = "train.policy.rnn_type"
    return f"a recurrent policy ({path}={cfg.train.policy.rnn_type}, {cfg.origins.of(path)})"
