"""Settings that are right by themselves and do not fit each other, or not the robot."""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import get_args

from legged.config.schema import TaskConfig
from legged.envs.terms import MirrorKind
from legged.errors import ConfigError, suggest
from legged.robots.robot import Robot

MOST_IN_A_POOL = 2**31 - 1
"""Contacts or constraint rows of all robots, which engines count in 32 bits."""
MOST_SAMPLES = 2**28
"""Samples of an iteration."""
MOST_WEIGHTS = 2**30
"""Weights of a network; with gradients and the optimiser's moments 16 GB."""
MOST_POINTS = 10_000
"""Heights measured around a robot."""


def check_base_mass(cfg: TaskConfig, robot: Robot) -> None:
    """The lightest base that may be drawn has a mass.

    Raises:
        ConfigError: it has none.
    """
    lowest = cfg.domain_rand.added_mass_range[0]
    if cfg.domain_rand.randomize_base_mass and robot.base_mass + lowest <= 0.0:
        where, mass = cfg.origins.where("domain_rand.added_mass_range"), robot.base_mass
        raise ConfigError(
            f"{where}: the base of '{robot.name}' weighs {mass:.4g} kg, so the lowest added mass must be above {-mass:.4g},"
            f" got {lowest:g}"
        )


def check_sizes(cfg: TaskConfig) -> None:
    """What is allocated for all robots together can be numbered.

    Raises:
        ConfigError: it can't.
    """
    robots, steps = cfg.env.num_envs, cfg.train.runner.num_steps_per_env
    for field in ("nconmax", "njmax"):
        size = robots * getattr(cfg.sim, field)
        if size > MOST_IN_A_POOL:
            raise ConfigError(
                f"{cfg.origins.where(f'sim.{field}')}: {getattr(cfg.sim, field)} for each of {robots} robots (env.num_envs:"
                f" {cfg.origins.of('env.num_envs')}) are {size:,}, more than {MOST_IN_A_POOL:,}"
            )
    if robots * steps > MOST_SAMPLES:
        raise ConfigError(
            f"{cfg.origins.where('train.runner.num_steps_per_env')}: {steps} steps of {robots} robots (env.num_envs:"
            f" {cfg.origins.of('env.num_envs')}) are {robots * steps:,} samples an iteration, more than {MOST_SAMPLES:,}"
        )
    for network in ("actor", "critic"):
        field = f"train.policy.{network}_hidden_dims"
        widths = getattr(cfg.train.policy, f"{network}_hidden_dims")
        weights = sum(a * b for a, b in pairwise(widths))
        if weights > MOST_WEIGHTS:
            raise ConfigError(f"{cfg.origins.where(field)}: these are {weights:,} weights, more than {MOST_WEIGHTS:,}")
    points = len(cfg.terrain.measured_points_x) * len(cfg.terrain.measured_points_y)
    if points > MOST_POINTS:
        raise ConfigError(
            f"{cfg.origins.where('terrain.measured_points_x')}: with measured_points_y they are {points:,} points, more than"
            f" {MOST_POINTS:,}"
        )


def check_mirror_kinds(task: str, mirrored: Mapping[str, str], used: Iterable[str], where: str) -> None:
    """Every observation in use says how it is mirrored, in a way that there is; `task` is the name of the class.

    Raises:
        ConfigError: `where`, and which one does not.
    """
    otherwise = "false learns without mirror images"
    kinds = get_args(MirrorKind)
    for name in used:
        if name not in mirrored:
            missing = f"{task}.MIRRORED does not say how observation '{name}' is mirrored"
            raise ConfigError(f"{where}: {missing}; {otherwise}")
        if mirrored[name] not in kinds:
            unknown = f"{task}.MIRRORED: observation '{name}' has the unknown kind {mirrored[name]!r}"
            raise ConfigError(f"{where}: {unknown}{suggest(str(mirrored[name]), kinds, 'kinds')}; {otherwise}")
