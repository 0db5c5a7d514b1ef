"""Checks of settings that are valid by themselves but may not fit each other or the task class."""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import get_args

from legged.config.legged import follows_velocities
from legged.config.networks import check_networks, learns_from_teacher
from legged.config.schema import TaskConfig
from legged.envs.class_checks import check_overrides, check_terms
from legged.envs.randomization_checks import check_observed, check_randomization
from legged.errors import ConfigError, suggest
from legged.mdp.mirror_images import MirrorKind
from legged.physics.quantities import LAST_STEP, STAGES

RESERVED = {"falls", "episode_length", "non_finite_worlds", "contact_overflows"}
"""Names of metrics that every task logs."""
FOLLOWING = ("lin_vel_rmse", "ang_vel_rmse", "falls", "return")
"""Figures that evaluations during training report for robots that follow commands. By default, the first one decides which
policy is the best.
"""
RETURNING = ("return", "falls", "episode_length")
"""Figures that evaluations during training report for tasks without commands."""
MOST_IN_A_POOL = 2**31 - 1
"""Largest number of contacts, or of constraint rows, summed over all robots. Engines count them with 32-bit integers."""
MOST_SAMPLES = 2**28
"""Largest number of samples in an iteration."""
MOST_WEIGHTS = 2**30
"""Largest number of weights between the hidden layers of a network. So many weights, their gradients and the optimiser's
moments take 16 GiB."""


def check_task(cls: type, cfg: TaskConfig) -> None:
    """Check the parts of a configuration that do not depend on a robot, for a task of class `cls`.

    Raises:
        ConfigError: a setting does not fit the class or another setting.
    """
    check_overrides(cls)
    check_terms(cls, cfg)
    if cfg.train.algorithm.symmetry and not hasattr(cls, "MIRRORED"):
        where = cfg.origins.where("train.algorithm.symmetry")
        raise ConfigError(f"{where}: {cls.__name__} has no mirror images (table MIRRORED); set symmetry to false")
    check_networks(cfg)
    for name in RESERVED & cls.terms("_metric_"):  # type: ignore[attr-defined]
        raise ConfigError(f"{cls.__name__}._metric_{name}: every task logs Metrics/{name} already; rename the method")
    for name in cfg.terminations.failures:
        if name in cfg.terminations.time_outs:
            where = cfg.origins.where("terminations.time_outs")
            raise ConfigError(f"{where}: '{name}' is also in terminations.failures; remove it from one of the two")
    for name in cls.QUANTITIES:  # type: ignore[attr-defined]
        if name not in (*STAGES, *LAST_STEP):
            known = suggest(name, (*STAGES, *LAST_STEP), "quantities")
            raise ConfigError(f"{cls.__name__}.QUANTITIES: there is no quantity '{name}'{known}")
    check_randomization(cfg)
    check_observed(cfg)
    check_sizes(cfg)
    check_lengths(cfg)
    check_evaluation(cls, cfg)


def evaluated_figures(cls: type, cfg: TaskConfig) -> tuple[str, ...]:
    """Return the names of the figures that evaluations during training report for a task of class `cls`: the standard
    figures, then the task's metrics. The first one decides which policy is best, unless train.runner.best_by names another.
    """
    first = FOLLOWING if follows_velocities(cfg) else RETURNING
    return *first, *sorted(cls.terms("_metric_") - {*first})  # type: ignore[attr-defined]


def lower_is_better(figure: str) -> bool:
    """Return True if smaller values of a figure are better: for errors and for the share of falls."""
    return figure.endswith("_rmse") or figure == "falls"


def check_evaluation(cls: type, cfg: TaskConfig) -> None:
    """Check the settings of evaluations during training.

    Raises:
        ConfigError: best_by or stop_at names an unknown figure, stop_at is set but evaluate_interval is not, or an evaluation
            is shorter than a control step.
    """
    runner, figures = cfg.train.runner, evaluated_figures(cls, cfg)
    asked = {f"train.runner.stop_at.{name}": name for name in runner.stop_at}
    if runner.best_by:
        asked["train.runner.best_by"] = runner.best_by
    for path, name in asked.items():
        if name not in figures:
            where = cfg.origins.where(path)
            raise ConfigError(f"{where}: evaluations of '{cfg.task}' report no {name!r}{suggest(name, figures, 'figures')}")
    if runner.stop_at and not runner.evaluate_interval:
        where = cfg.origins.where("train.runner.stop_at")
        raise ConfigError(f"{where}: needs evaluations during training; set train.runner.evaluate_interval, such as 50")
    if runner.evaluate_interval and runner.evaluate_s and round(runner.evaluate_s / cfg.dt) < 1:
        where, given = cfg.origins.where("train.runner.evaluate_s"), runner.evaluate_s
        raise ConfigError(
            f"{where}: must be at least a control step of {cfg.dt:g} s (sim.dt * control.decimation), or 0, got {given:g}"
        )


def check_lengths(cfg: TaskConfig) -> None:
    """Check that an episode has at least one control step, and a mini-batch at least one sample.

    Raises:
        ConfigError: an episode or a mini-batch is too short.
    """
    origins = cfg.origins
    if round(cfg.env.episode_length_s / cfg.dt) < 1:
        where, given = origins.where("env.episode_length_s"), cfg.env.episode_length_s
        raise ConfigError(
            f"{where}: must be at least a control step of {cfg.dt:g} s (sim.dt * control.decimation), got {given:g}"
        )
    samples = cfg.env.num_envs * cfg.train.runner.num_steps_per_env
    if cfg.train.algorithm.num_mini_batches > samples and not learns_from_teacher(cfg):
        where, given = origins.where("train.algorithm.num_mini_batches"), cfg.train.algorithm.num_mini_batches
        raise ConfigError(
            f"{where}: must be at most the {samples} samples of an iteration (num_envs * num_steps_per_env), got {given}"
        )


def check_sizes(cfg: TaskConfig) -> None:
    """Check that contacts, samples and weights do not exceed MOST_IN_A_POOL, MOST_SAMPLES and MOST_WEIGHTS.

    Raises:
        ConfigError: a size is too large.
    """
    robots, steps = cfg.env.num_envs, cfg.train.runner.num_steps_per_env
    for field in ("nconmax", "njmax"):
        size = robots * getattr(cfg.sim, field)
        if size > MOST_IN_A_POOL:
            raise ConfigError(
                f"{cfg.origins.where(f'sim.{field}')}: {getattr(cfg.sim, field)} for each of {robots} robots (env.num_envs:"
                f" {cfg.origins.of('env.num_envs')}) make {size:,} in total, more than {MOST_IN_A_POOL:,}"
            )
    if robots * steps > MOST_SAMPLES:
        raise ConfigError(
            f"{cfg.origins.where('train.runner.num_steps_per_env')}: {steps} steps of {robots} robots (env.num_envs:"
            f" {cfg.origins.of('env.num_envs')}) are {robots * steps:,} samples per iteration, more than {MOST_SAMPLES:,}"
        )
    policy = cfg.train.policy
    for field, widths in (
        ("actor_hidden_dims", policy.actor_hidden_dims),
        ("critic_hidden_dims", policy.critic_hidden_dims),
        ("estimator.hidden_dims", policy.estimator.hidden_dims),
    ):
        weights = sum(a * b for a, b in pairwise(widths))
        if weights > MOST_WEIGHTS:
            where = cfg.origins.where(f"train.policy.{field}")
            raise ConfigError(f"{where}: these widths make {weights:,} weights, more than {MOST_WEIGHTS:,}")


def check_mirror_kinds(task: str, mirrored: Mapping[str, str], used: Iterable[str], where: str) -> None:
    """Check that the table `mirrored` gives a valid kind of mirroring for every observation in `used`. `mirrored` is the
    table MIRRORED of the class `task`. Error messages begin with `where`.

    Raises:
        ConfigError: an observation has no kind, or an unknown kind.
    """
    otherwise = "set train.algorithm.symmetry=false to learn without mirror images"
    kinds = get_args(MirrorKind)
    for name in used:
        if name not in mirrored:
            missing = f"{task}.MIRRORED does not say how observation '{name}' is mirrored"
            raise ConfigError(f"{where}: {missing}; {otherwise}")
        if mirrored[name] not in kinds:
            unknown = f"{task}.MIRRORED: observation '{name}' has the unknown kind {mirrored[name]!r}"
            raise ConfigError(f"{where}: {unknown}{suggest(str(mirrored[name]), kinds, 'kinds')}; {otherwise}")
