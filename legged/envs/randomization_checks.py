"""Checks of `domain_rand` settings that are valid by themselves but may not fit the property, the task or the robot."""

from collections.abc import Callable

from legged.config.networks import groups_in, path_of_terms
from legged.config.randomization import DrawConfig, ForceConfig, KickConfig, draw_of
from legged.config.robot import has_robot
from legged.config.schema import RobotConfig, TaskConfig
from legged.envs.privileged_terms import MIRROR_KINDS, PREFIX, observed, observed_forces
from legged.errors import ConfigError, suggest
from legged.physics.fields import FIELDS
from legged.physics.scene.robot_scene import body_names
from legged.robots.robot import Robot


def check_randomization(cfg: TaskConfig) -> None:
    """Check the ranges of randomised properties, before anything is built.

    Raises:
        ConfigError: a property does not exist, has an invalid entry, or does not fit the engine or the control law.
    """
    rand, legged = cfg.domain_rand, has_robot(cfg)
    for key, ranges in (("ranges", rand.ranges), ("observed_ranges", rand.observed_ranges)):
        for name, entry in ranges.items():
            _check_draw(name, draw_of(entry), legged, f"domain_rand.{key}.{name}", cfg.origins.where)
    _check_derived(cfg)
    if cfg.sim.physics == "newton" and cfg.sim.solver != "mujoco":
        for name, entry in rand.ranges.items():
            if draw_of(entry).when != "start":
                where = cfg.origins.where(f"domain_rand.ranges.{name}.when")
                raise ConfigError(f"{where}: {cfg.sim.solver} can't change properties after the start; set sim.solver=mujoco")
    if has_robot(cfg) and cfg.control.laws == {"T"}:
        for name in ("p_gain", "d_gain", "joint_offset"):
            if name in rand.ranges:
                where = cfg.origins.where(f"domain_rand.ranges.{name}")
                raise ConfigError(
                    f"{where}: control.control_type T takes actions as torques, and has no {FIELDS[name].meaning}"
                )
    actuator = cfg.control.actuator if has_robot(cfg) else None
    if actuator is not None and actuator.network and not actuator.joints:
        for name in ("p_gain", "d_gain"):
            if name in rand.ranges:
                raise ConfigError(
                    f"{cfg.origins.where(f'domain_rand.ranges.{name}')}: all joints have a learned actuator"
                    " (control.actuator.network), which has no gains to draw"
                )
    if has_robot(cfg) and "P" not in cfg.control.laws and "joint_offset" in rand.ranges:
        where = cfg.origins.where("domain_rand.ranges.joint_offset")
        raise ConfigError(f"{where}: control.control_type V does not read joint angles, so an offset has no effect")


def _check_draw(name: str, draw: DrawConfig, legged: bool, path: str, where: Callable[[str], str]) -> None:
    """Check the entry of one property; `legged` is True for tasks of legged robots.

    Raises:
        ConfigError: the property does not exist in this task, or its entry is invalid.
    """
    if name not in FIELDS:
        known = suggest(name, FIELDS, "properties")
        raise ConfigError(f"{where(path)}: there is no property '{name}' to randomise{known}")
    field, (low, high) = FIELDS[name], draw.range
    unit = "" if field.unit == "1" else f" [{field.unit}]"
    if not field.changes and not legged:
        raise ConfigError(f"{where(path)}: only tasks of legged robots have this property ({field.meaning})")
    for bound, wrong, word in ((field.lowest, low, "least"), (field.highest, high, "most")):
        if bound is not None and (wrong < bound if word == "least" else wrong > bound):
            raise ConfigError(f"{where(path)}: must be at {word} {bound:g}{unit} ({field.meaning}), got {wrong:g}")
    if draw.distribution == "log_uniform" and low <= 0.0:
        given = where(f"{path}.distribution")
        raise ConfigError(f"{given}: log_uniform draws from ranges above 0 only, got [{low:g}, {high:g}]")
    if draw.std and draw.distribution != "gaussian":
        raise ConfigError(f"{where(f'{path}.std')}: only gaussian has a standard deviation, {draw.distribution} has none")
    if draw.when == "interval" and not draw.interval_s:
        raise ConfigError(f"{where(f'{path}.when')}: interval needs an interval_s above 0 [s], such as interval_s: 4.0")
    if draw.when != "interval" and draw.interval_s:
        told = f"needs `when: interval`, got {draw.interval_s:g} with `when: {draw.when}`"
        raise ConfigError(f"{where(f'{path}.interval_s')}: {told}")
    _check_grow(draw, path, where)
    if draw.grow[1] and draw.when == "start":
        raise ConfigError(f"{where(f'{path}.grow')}: the range can't widen if the property is drawn only at the start")
    if draw.grow[1] and field.derived:
        raise ConfigError(
            f"{where(f'{path}.grow')}: the range can't widen: MuJoCo derives constants from the property, so the values of"
            " all later draws are fixed at the start"
        )


def _check_grow(of: DrawConfig | KickConfig | ForceConfig, path: str, where: Callable[[str], str]) -> None:
    """Check the iterations between which a range widens.

    Raises:
        ConfigError: the first and the last iteration are equal, and not 0.
    """
    if of.grow != (0.0, 0.0) and of.grow[0] == of.grow[1]:
        told = "expected [first, last] with first < last, or [0, 0] for a constant range"
        raise ConfigError(f"{where(f'{path}.grow')}: {told}, got {list(of.grow)}")


def _check_derived(cfg: TaskConfig) -> None:
    """Check that all properties from which MuJoCo derives constants are drawn at the same moments.

    Raises:
        ConfigError: two of them are drawn at different moments.
    """
    moments = {}
    for name, entry in cfg.domain_rand.ranges.items():
        if FIELDS[name].derived:
            draw = draw_of(entry)
            moments[name] = draw.when, draw.interval_s
    if has_robot(cfg) and cfg.domain_rand.randomize_base_mass:
        moments.setdefault("added_base_mass", ("start", 0.0))
    for name, moment in moments.items():
        first = next(iter(moments))
        if moment != moments[first]:
            a, b = ("at the start" if when == "start" else f"at {when}" for when, _ in (moments[first], moment))
            path = name if name in cfg.domain_rand.ranges else first
            names = ", ".join(moments)
            text = f"MuJoCo derives constants from {names} together, so they must have the same `when` and interval_s"
            if "added_base_mass" in moments and "added_base_mass" not in cfg.domain_rand.ranges:
                text += " (randomize_base_mass draws at the start; add added_base_mass to domain_rand.ranges instead)"
            raise ConfigError(f"{cfg.origins.where(f'domain_rand.ranges.{path}')}: {first} is drawn {a}, {name} {b}: {text}")


def check_disturbances(cfg: RobotConfig, robot: Robot) -> None:
    """Check kicks and forces.

    Raises:
        ConfigError: a kick or force has no effect, has an invalid `grow`, or names a body that the robot does not have.
    """
    where = cfg.origins.where
    for name, kick in cfg.domain_rand.kicks.items():
        _check_grow(kick, f"domain_rand.kicks.{name}", where)
        if all(getattr(kick, axis) == (0.0, 0.0) for axis in ("x", "y", "z", "roll", "pitch", "yaw")):
            raise ConfigError(
                f"{where(f'domain_rand.kicks.{name}')}: it kicks nothing; give a range for x, y, z, roll, pitch or yaw"
            )
    for name, force in cfg.domain_rand.forces.items():
        path = f"domain_rand.forces.{name}"
        _check_grow(force, path, where)
        if all(getattr(force, axis) == (0.0, 0.0) for axis in ("x", "y", "z")):
            raise ConfigError(f"{where(path)}: it pushes nothing; give a range for x, y or z [N]")
        bodies = body_names(robot)
        if force.body and force.body not in bodies:
            told = suggest(force.body, bodies, "bodies")
            raise ConfigError(f"{where(f'{path}.body')}: '{robot.name}' has no body '{force.body}'{told}")


def check_observed(cfg: TaskConfig) -> None:
    """Check that observed properties are randomised, and that they have a mirror image if train.algorithm.symmetry is on.

    Raises:
        ConfigError: a property is not randomised, or has no mirror image.
    """
    for group, section in groups_in(cfg).items():
        for term in section.terms:
            path = path_of_terms(cfg, group)
            name = term.removeprefix(PREFIX)
            if term.startswith(PREFIX) and name in FIELDS and observed(cfg, name) is None:
                where = cfg.origins.where(path)
                raise ConfigError(
                    f"{where}: {term}: domain_rand.ranges does not draw '{name}', so there is nothing to observe"
                )
            draw = observed(cfg, name) if term.startswith(PREFIX) and name in FIELDS else None
            if draw is not None and cfg.train.algorithm.symmetry and MIRROR_KINDS[term] in ("sideways", "joints"):
                low, high = draw.range
                if abs(low + high) > 1e-6 * max(abs(low), abs(high)):  # the mirrored observation could be outside [-1, 1]
                    raise ConfigError(
                        f"{cfg.origins.where(path)}: {term}: its range [{low:g}, {high:g}] is not symmetric about 0, so"
                        " the term has no mirror image; set a symmetric range or train.algorithm.symmetry=false"
                    )
            if term == "push_force" and has_robot(cfg) and not observed_forces(cfg):
                raise ConfigError(f"{cfg.origins.where(path)}: push_force: domain_rand.forces names no force to observe")
            if term == "push_force" and has_robot(cfg) and cfg.train.algorithm.symmetry:
                aside = [force.body for force in observed_forces(cfg).values() if force.body]
                if aside:
                    raise ConfigError(
                        f"{cfg.origins.where(path)}: push_force: a force on '{aside[0]}' has no mirror image, because only"
                        " forces on the base have one; remove the term or set train.algorithm.symmetry=false"
                    )
