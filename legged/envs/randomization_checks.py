"""Checks of `domain_rand` settings that are valid by themselves but may not fit the property, the task or the robot."""

from collections.abc import Callable

from legged.config.networks import groups_in, path_of_terms
from legged.config.randomization import DrawConfig, Range, draw_of
from legged.config.robot import RobotConfig, has_robot
from legged.config.task import TaskConfig
from legged.envs.privileged_terms import MIRROR_KINDS, PREFIX, observed, observed_forces
from legged.errors import ConfigError, suggest
from legged.physics.fields import FIELDS
from legged.physics.scene.robot_scene import body_names
from legged.robots.patterns import match_names
from legged.robots.robot import Robot

Error = Callable[[str, str], ConfigError]
"""Function: (dotted path of a setting, text) -> error about the setting, as `Origins.error` returns."""


def check_randomization(cfg: TaskConfig) -> None:
    """Check the ranges of randomised properties, before anything is built.

    Raises:
        ConfigError: a property does not exist, has an invalid entry, or does not fit the engine or the control law.
    """
    rand, error = cfg.domain_rand, cfg.origins.error
    for key, ranges in (("ranges", rand.ranges), ("observed_ranges", rand.observed_ranges)):
        for name, entry in ranges.items():
            path = f"domain_rand.{key}.{name}"
            if name not in FIELDS:
                raise error(path, f"there is no property '{name}' to randomise{suggest(name, FIELDS, 'properties')}")
            if not FIELDS[name].changes and not has_robot(cfg):
                raise error(path, f"only tasks of legged robots have this property ({FIELDS[name].meaning})")
            _check_draw(name, draw_of(entry), path, error)
    _check_derived(cfg)
    fixed = cfg.sim.solver if cfg.sim.physics == "newton" and cfg.sim.solver != "mujoco" else ""
    for name, entry in rand.ranges.items():
        path = f"domain_rand.ranges.{name}"
        if fixed and draw_of(entry).when != "start":
            raise error(f"{path}.when", f"{fixed} can't change properties after the start; set sim.solver=mujoco")
        if has_robot(cfg) and (why := _why_without_effect(name, cfg)):
            raise error(path, why)


def _why_without_effect(name: str, cfg: RobotConfig) -> str:
    """Return why a property of the control law has no effect under a configuration; empty if it has one."""
    laws, actuator = cfg.control.laws, cfg.control.actuator
    if name in ("p_gain", "d_gain", "joint_offset") and laws == {"T"}:
        return f"control.control_type T takes actions as torques, and has no {FIELDS[name].meaning}"
    if name in ("p_gain", "d_gain") and actuator.network and not actuator.joints:
        return "all joints have a learned actuator (control.actuator.network), which has no gains to draw"
    if name == "joint_offset" and "P" not in laws:
        return "control.control_type V does not read joint angles, so an offset has no effect"
    return ""


def _check_draw(name: str, draw: DrawConfig, path: str, error: Error) -> None:
    """Check the entry of one property.

    Raises:
        ConfigError: the range is beyond the property's bounds, or settings of the entry contradict each other.
    """
    field, (low, high) = FIELDS[name], draw.range
    unit = "" if field.unit == "1" else f" [{field.unit}]"
    if field.lowest is not None and low < field.lowest:
        raise error(path, f"must be at least {field.lowest:g}{unit} ({field.meaning}), got {low:g}")
    if field.highest is not None and high > field.highest:
        raise error(path, f"must be at most {field.highest:g}{unit} ({field.meaning}), got {high:g}")
    _check_grow(draw.grow, path, error)
    if draw.distribution == "log_uniform" and low <= 0.0:
        raise error(f"{path}.distribution", f"log_uniform draws from ranges above 0 only, got [{low:g}, {high:g}]")
    if draw.std and draw.distribution != "gaussian":
        raise error(f"{path}.std", f"only gaussian has a standard deviation, {draw.distribution} has none")
    if draw.when == "interval" and not draw.interval_s:
        raise error(f"{path}.when", "interval needs an interval_s above 0 [s], such as interval_s: 4.0")
    if draw.when != "interval" and draw.interval_s:
        text = f"needs `when: interval`, got {draw.interval_s:g} with `when: {draw.when}`"
        raise error(f"{path}.interval_s", text)
    if draw.grow[1] and draw.when == "start":
        raise error(f"{path}.grow", "the range can't widen if the property is drawn only at the start")
    if draw.grow[1] and field.derived:
        why = "MuJoCo derives constants from the property, so the values of all later draws are fixed at the start"
        raise error(f"{path}.grow", f"the range can't widen: {why}")


def _check_grow(grow: Range, path: str, error: Error) -> None:
    """Check the iterations between which a range widens.

    Raises:
        ConfigError: the first and the last iteration are equal, and not 0.
    """
    if grow[0] == grow[1] != 0.0:
        expected = "expected [first, last] with first < last, or [0, 0] for a constant range"
        raise error(f"{path}.grow", f"{expected}, got {list(grow)}")


def _check_derived(cfg: TaskConfig) -> None:
    """Check that all properties from which MuJoCo derives constants are drawn at the same moments.

    Raises:
        ConfigError: two of them are drawn at different moments.
    """
    ranges = cfg.domain_rand.ranges
    draws = {name: draw_of(entry) for name, entry in ranges.items() if FIELDS[name].derived}
    if has_robot(cfg) and cfg.domain_rand.randomize_base_mass:
        draws.setdefault("added_base_mass", DrawConfig())
    first = next(iter(draws), "")
    for name, draw in draws.items():
        if (draw.when, draw.interval_s) != (draws[first].when, draws[first].interval_s):
            a, b = ("at the start" if each == "start" else f"at {each}" for each in (draws[first].when, draw.when))
            text = (
                f"MuJoCo derives constants from {', '.join(draws)} together, so they must have the same `when` and interval_s"
            )
            if "added_base_mass" in draws and "added_base_mass" not in ranges:
                text += " (randomize_base_mass draws at the start; add added_base_mass to domain_rand.ranges instead)"
            path = f"domain_rand.ranges.{name if name in ranges else first}"
            raise cfg.origins.error(path, f"{first} is drawn {a}, {name} {b}: {text}")


def check_disturbances(cfg: RobotConfig, robot: Robot) -> None:
    """Check kicks, forces, and the growth of held joints' goals.

    Raises:
        ConfigError: a kick or force has no effect, has an invalid `grow`, or names a body or joint that the robot does not
            have; or a force has two places or two sizes.
    """
    error, rand = cfg.origins.error, cfg.domain_rand
    for table, axes, text in (
        ("kicks", ("x", "y", "z", "roll", "pitch", "yaw"), "it kicks nothing; give a range for x, y, z, roll, pitch or yaw"),
        ("forces", ("x", "y", "z", "size"), "it pushes nothing; give a range for x, y or z, or for size [N]"),
    ):
        for name, entry in getattr(rand, table).items():
            path = f"domain_rand.{table}.{name}"
            _check_grow(entry.grow, path, error)
            if all(getattr(entry, axis) == (0.0, 0.0) for axis in axes):
                raise error(path, text)
    bodies = body_names(robot) if rand.forces else ()
    _check_grow(rand.held_goals.grow, "domain_rand.held_goals", error)
    for name, force in rand.forces.items():
        path = f"domain_rand.forces.{name}"
        if force.size != (0.0, 0.0) and any(getattr(force, axis) != (0.0, 0.0) for axis in "xyz"):
            raise error(f"{path}.size", "a force of any direction has no x, y and z; remove either them or size")
        if force.joints and force.body:
            raise error(f"{path}.joints", f"the force acts on the body '{force.body}' already; remove either body or joints")
        if force.joints:
            match_names(force.joints, robot.joint_names, cfg.origins.where(f"{path}.joints"))
        if force.body and force.body not in bodies:
            unknown = f"'{robot.name}' has no body '{force.body}'{suggest(force.body, bodies, 'bodies')}"
            raise error(f"{path}.body", unknown)


def check_observed(cfg: TaskConfig) -> None:
    """Check that observed properties are randomised, and that they have a mirror image if train.algorithm.symmetry is on.

    Raises:
        ConfigError: a property is not randomised, or has no mirror image.
    """
    for group, section in groups_in(cfg).items():
        for term in section.terms:
            name, why = term.removeprefix(PREFIX), ""
            if term == "push_force" and has_robot(cfg):
                why = _why_force_unobserved(cfg)
            elif term.startswith(PREFIX) and name in FIELDS:
                why = _why_unobserved(cfg, name)
            if why:
                raise cfg.origins.error(path_of_terms(cfg, group), f"{term}: {why}")


def _why_unobserved(cfg: TaskConfig, name: str) -> str:
    """Return why a property can't be observed; empty if it can."""
    draw = observed(cfg, name)
    if draw is None:
        return f"domain_rand.ranges does not draw '{name}', so there is nothing to observe"
    low, high = draw.range
    changes_sign = cfg.train.algorithm.symmetry and MIRROR_KINDS[f"{PREFIX}{name}"] in ("sideways", "joints")
    if not changes_sign or abs(low + high) <= 1e-6 * max(abs(low), abs(high)):
        return ""
    otherwise = "set a symmetric range or train.algorithm.symmetry=false"  # the mirrored observation could be outside [-1, 1]
    return f"its range [{low:g}, {high:g}] is not symmetric about 0, so the term has no mirror image; {otherwise}"


def _why_force_unobserved(cfg: RobotConfig) -> str:
    """Return why the forces on bodies can't be observed; empty if they can."""
    forces = observed_forces(cfg)
    if not forces:
        return "domain_rand.forces names no force to observe"
    aside = next((force.body or ", ".join(force.joints) for force in forces.values() if force.body or force.joints), "")
    if not aside or not cfg.train.algorithm.symmetry:
        return ""
    reason = f"a force on '{aside}' has no mirror image, because only forces on the base have one"
    return f"{reason}; remove the term or set train.algorithm.symmetry=false"
