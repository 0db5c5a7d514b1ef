"""Checks of a robot's settings that are valid by themselves but may not fit each other or the robot."""

from typing import Any, get_args

from legged.config.checks import shown
from legged.config.legged import LeggedConfig
from legged.config.networks import groups_in, path_of_terms
from legged.config.randomization import draw_of
from legged.config.robot import RobotConfig
from legged.envs.privileged_terms import MIRROR_KINDS, PREFIX, observed
from legged.envs.randomization_checks import check_disturbances
from legged.envs.robot_terms import observed_joints
from legged.errors import ConfigError, suggest
from legged.mdp.actuators.actuator import check_actuator
from legged.mdp.actuators.motor_curve import check_motor_model, check_slowest
from legged.mdp.control import acted_joints, action_scales, check_wheels, control_gains
from legged.mdp.held_goals import held_walk
from legged.mdp.mirror_images import MirrorKind, mirror_of_actions
from legged.physics.fields import FIELDS
from legged.robots.robot import Robot
from legged.terrain import check_terrain

MOST_POINTS = 10_000
"""Largest number of points in the height scan."""
MOST_VALUES = 10_000
"""Largest number of values of an axis of commands."""


def check_legged(cls: Any, cfg: RobotConfig, robot: Robot) -> None:
    """Check a robot's settings, except those that `check_task` checks. `cls` is the task's class.

    Raises:
        ConfigError: a setting does not fit the robot or another setting.
    """
    if cfg.train.algorithm.symmetry:
        check_symmetry(cls, cfg, robot)
    control_gains(robot, cfg.control, cfg.origins.where)
    action_scales(robot, cfg.control, cfg.origins.where)
    check_wheels(robot, cfg.control, cfg.origins.where)
    check_actuator(robot, cfg.control, cfg.sim.dt, cfg.origins)
    check_motor_model(cfg.control.actuator, cfg.origins)
    if "velocity_limit" in cfg.domain_rand.ranges:
        lowest = draw_of(cfg.domain_rand.ranges["velocity_limit"]).range[0]
        check_slowest(robot, cfg.control, cfg.sim.dt, lowest, cfg.origins.where)
    check_terrain(cfg.terrain, cfg.origins)
    check_disturbances(cfg, robot)
    if cfg.domain_rand.held_goals.step:
        held_walk(cfg.domain_rand.held_goals, robot, cfg.control, cfg.origins.where)
    observed_joints(robot, cfg.observations.joints, cfg.origins.where)
    check_robot(cfg, robot)


def check_symmetry(cls: Any, cfg: RobotConfig, robot: Robot) -> None:
    """Check that robot, default pose, actions, observations and height scan have a mirror image.

    Raises:
        ConfigError: one of them has no mirror image.
    """
    origins, path = cfg.origins, "train.algorithm.symmetry"
    otherwise = f"set {path}=false to learn without mirror images"

    def fault(text: str) -> ConfigError:
        return origins.error(path, f"{text}; {otherwise}")

    if robot.mirror is None:
        raise fault(f"left and right of '{robot.name}' are not symmetric (at zero joint angles)")
    uneven = robot.mirror.uneven_joint(robot.default_dof_pos)
    if uneven is not None:  # the observation `dof_pos` and the actions are relative to this pose, so it must be symmetric too
        partner = robot.mirror.joints[uneven]
        angles = ", ".join(f"{robot.joint_names[i]} {robot.default_dof_pos[i]:g} rad" for i in sorted({uneven, partner}))
        raise fault(f"left and right default_joint_angles of '{robot.name}' are not symmetric ({angles})")
    acted = acted_joints(robot, cfg.control, origins.where)
    image = mirror_of_actions(robot.mirror, acted)
    if image is None:
        raise origins.error("control.held", f"joints are held on one side only; {otherwise} ({origins.where(path)})")
    if mirror_of_actions(robot.mirror, observed_joints(robot, cfg.observations.joints, origins.where)) is None:
        raise origins.error(
            "observations.joints", f"joints are observed on one side only; {otherwise} ({origins.where(path)})"
        )
    laws = robot.each(cfg.control.control_type, origins.where("control.control_type"))[list(acted)].tolist()
    scales = action_scales(robot, cfg.control, origins.where).tolist()
    for field, values in (("control_type", laws), ("action_scale", scales)):
        for i, partner in enumerate(image[0]):
            if values[i] != values[partner]:
                pair = ", ".join(f"{robot.joint_names[acted[k]]} {shown(values[k])}" for k in sorted((i, partner)))
                text = f"left and right joints have different values ({pair}); {otherwise} ({origins.where(path)})"
                raise origins.error(f"control.{field}", text)
    used = [term for group in groups_in(cfg).values() for term in group.terms]
    kinds = get_args(MirrorKind)
    for name in used:
        if name not in cls.MIRRORED:
            raise fault(f"{cls.__name__}.MIRRORED does not say how observation '{name}' is mirrored")
        if (kind := cls.MIRRORED[name]) not in kinds:
            near = suggest(str(kind), kinds, "kinds")
            raise fault(f"{cls.__name__}.MIRRORED: observation '{name}' has the unknown kind {kind!r}{near}")
    for name in FIELDS:
        if f"{PREFIX}{name}" in used:
            check_mirrored_draw(cfg, robot, name)
    y = cfg.terrain.measured_points_y
    if sorted(y) != sorted(-value for value in y):
        points = f"terrain.measured_points_y ({origins.of('terrain.measured_points_y')})"
        raise origins.error(path, f"{points} must be symmetric about 0, got {list(y)}")


def check_mirrored_draw(cfg: RobotConfig, robot: Robot, name: str) -> None:
    """Check that an observed, randomised property has a mirror image.

    A property with a number for each body, shape or passive joint has no mirror image, because these parts are not paired
    left and right. One offset for all joints has no mirror image, because mirroring changes the sign of some joints' offsets.

    Raises:
        ConfigError: the property has no mirror image.
    """
    draw, kind = observed(cfg, name), MIRROR_KINDS[f"{PREFIX}{name}"]
    if draw is None:
        return
    each = FIELDS[name].each if draw.each is None else draw.each
    passive = name.startswith("joint_") and robot.passive is not None and bool(robot.passive.names)
    unpaired = each and (kind == "scalar" or (kind == "of_joints" and passive))
    if unpaired or (kind == "joints" and not each):
        table = "ranges" if name in cfg.domain_rand.ranges else "observed_ranges"
        what = f"numbers for each of the {FIELDS[name].what} have" if each else "one number for all joints has"
        raise cfg.origins.error(
            f"domain_rand.{table}.{name}.each",
            f"{PREFIX}{name} is observed, and {what} no mirror image; set each to {str(not each).lower()}, or set"
            " train.algorithm.symmetry=false to learn without mirror images",
        )


def check_robot(cfg: RobotConfig, robot: Robot) -> None:
    """Check that passive and held joints are observed only if the robot has some, that self-collisions are punished only if
    they are simulated, that the lightest base that can be drawn has a positive mass, and that the height scan fits in memory.

    Raises:
        ConfigError: one of these is not so.
    """
    for group, observed_group in groups_in(cfg).items():
        for term in observed_group.terms:
            if term in ("passive_pos", "passive_vel") and (robot.passive is None or not robot.passive.names):
                text = f"{term}: '{robot.name}' has no passive hinges or slides (passive_joints)"
                raise cfg.origins.error(path_of_terms(cfg, group), text)
            if term == "held_targets" and not cfg.control.held:
                raise cfg.origins.error(path_of_terms(cfg, group), f"{term}: control.held names no joints")
    if cfg.rewards.scales.get("self_collision") and not cfg.sim.self_collisions:
        text = "shapes of the robot only collide with each other with sim.self_collisions=true, got false"
        raise cfg.origins.error("rewards.scales.self_collision", text)
    mass, lowest = robot.base_mass, cfg.domain_rand.added_mass_range[0]
    if cfg.domain_rand.randomize_base_mass and mass + lowest <= 0.0:
        text = f"the base of '{robot.name}' weighs {mass:.4g} kg, so the lowest added mass must be above {-mass:.4g}"
        raise cfg.origins.error("domain_rand.added_mass_range", f"{text}, got {lowest:g}")
    points = len(cfg.terrain.measured_points_x) * len(cfg.terrain.measured_points_y)
    if points > MOST_POINTS:
        text = f"the height scan has {points:,} points (measured_points_x times measured_points_y)"
        raise cfg.origins.error("terrain.measured_points_x", f"{text}, more than {MOST_POINTS:,}")


def check_commands(cfg: LeggedConfig) -> None:
    """Check commands of the base's height.

    Raises:
        ConfigError: a height can be 0.
    """
    low, high = cfg.commands.ranges.base_height
    if high > 0.0 and low <= 0.0:
        raise cfg.origins.error("commands.ranges.base_height", f"must be above 0 [m], or [0, 0], got [{low:g}, {high:g}]")


def check_grid(cfg: LeggedConfig) -> None:
    """Check each axis of evaluation's grid of commands.

    Raises:
        ConfigError: the low end of an axis is above the high end, the step is not positive, or the axis has too many values.
    """
    for axis in ("vx", "vy", "yaw"):
        low, high, step = given = getattr(cfg.evaluation, axis)
        if low > high or step <= 0.0:
            text = f"expected [low, high, step] with low <= high and step > 0, got {list(given)}"
            raise cfg.origins.error(f"evaluation.{axis}", text)
        if (count := (high - low) / step + 1.0) > MOST_VALUES:
            text = f"{list(given)} makes {count:,.0f} values; at most {MOST_VALUES:,} are possible"
            raise cfg.origins.error(f"evaluation.{axis}", text)
