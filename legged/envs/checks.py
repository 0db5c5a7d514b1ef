"""Checks of settings that are valid by themselves but may not fit each other or the task class."""

from itertools import pairwise
from operator import attrgetter
from typing import Any

from legged.config.legged import follows_velocities
from legged.config.networks import check_networks, learns_from_teacher
from legged.config.task import TaskConfig
from legged.envs.class_checks import check_class, check_terms
from legged.envs.randomization_checks import check_observed, check_randomization
from legged.errors import ConfigError, suggest

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


def check_task(cls: Any, cfg: TaskConfig) -> None:
    """Check the parts of a configuration that do not depend on a robot, for a task of class `cls`.

    Raises:
        ConfigError: a setting does not fit the class or another setting.
    """
    check_class(cls)
    check_terms(cls, cfg)
    if cfg.train.algorithm.symmetry and not hasattr(cls, "MIRRORED"):
        text = f"{cls.__name__} has no mirror images (table MIRRORED); set symmetry to false"
        raise cfg.origins.error("train.algorithm.symmetry", text)
    check_networks(cfg)
    check_randomization(cfg)
    check_observed(cfg)
    check_sizes(cfg)
    check_evaluation(cls, cfg)


def check_rewards(cls: Any, cfg: TaskConfig) -> None:
    """Check that a task that is trained from rewards has a reward, unless its class overrides `compute_reward`.

    Raises:
        ConfigError: all scales are 0, or `rewards.scales` is empty.
    """
    own = not cls.compute_reward.__module__.startswith("legged.")
    if not (own or learns_from_teacher(cfg) or any(cfg.rewards.scales.values())):
        known = ", ".join(sorted(cls.terms("_reward_")))
        raise ConfigError(f"{cfg.task}: rewards.scales: no reward has a scale other than 0 (rewards: {known})")


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
        ConfigError: best_by or stop_at names an unknown figure, or stop_at is set but evaluate_interval is not.
    """
    runner, figures = cfg.train.runner, evaluated_figures(cls, cfg)
    asked = {f"train.runner.stop_at.{name}": name for name in runner.stop_at}
    if runner.best_by:
        asked["train.runner.best_by"] = runner.best_by
    for path, name in asked.items():
        if name not in figures:
            unknown = f"evaluations of '{cfg.task}' report no {name!r}{suggest(name, figures, 'figures')}"
            raise cfg.origins.error(path, unknown)
    if runner.stop_at and not runner.evaluate_interval:
        needs = "needs evaluations during training; set train.runner.evaluate_interval, such as 50"
        raise cfg.origins.error("train.runner.stop_at", needs)


def check_sizes(cfg: TaskConfig) -> None:
    """Check that an episode and an evaluation have at least one control step, a mini-batch at least one sample, and that
    contacts, samples and weights do not exceed MOST_IN_A_POOL, MOST_SAMPLES and MOST_WEIGHTS.

    Raises:
        ConfigError: a size is too small or too large.
    """
    runner, error = cfg.train.runner, cfg.origins.error
    lengths = {"env.episode_length_s": (cfg.env.episode_length_s, "")}
    if runner.evaluate_interval and runner.evaluate_s:
        lengths["train.runner.evaluate_s"] = runner.evaluate_s, ", or 0"
    for path, (given, otherwise) in lengths.items():
        if round(given / cfg.dt) < 1:
            step = f"a control step of {cfg.dt:g} s (sim.dt * control.decimation)"
            raise error(path, f"must be at least {step}{otherwise}, got {given:g}")
    robots, steps, batches = cfg.env.num_envs, runner.num_steps_per_env, cfg.train.algorithm.num_mini_batches
    samples, of_robots = robots * steps, f"{robots} robots (env.num_envs: {cfg.origins.of('env.num_envs')})"
    if batches > samples and not learns_from_teacher(cfg):
        most = f"the {samples} samples of an iteration (num_envs * num_steps_per_env)"
        raise error("train.algorithm.num_mini_batches", f"must be at most {most}, got {batches}")
    for path, each in (("sim.nconmax", cfg.sim.nconmax), ("sim.njmax", cfg.sim.njmax)):
        if (size := robots * each) > MOST_IN_A_POOL:
            raise error(path, f"{each} for each of {of_robots} make {size:,} in total, more than {MOST_IN_A_POOL:,}")
    if samples > MOST_SAMPLES:
        many = f"{steps} steps of {of_robots} are {samples:,} samples per iteration, more than {MOST_SAMPLES:,}"
        raise error("train.runner.num_steps_per_env", many)
    for field in ("actor_hidden_dims", "critic_hidden_dims", "estimator.hidden_dims"):
        weights = sum(a * b for a, b in pairwise(attrgetter(field)(cfg.train.policy)))
        if weights > MOST_WEIGHTS:
            raise error(f"train.policy.{field}", f"these widths make {weights:,} weights, more than {MOST_WEIGHTS:,}")
