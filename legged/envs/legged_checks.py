"""Checks of a robot's settings that are valid by themselves but may not fit each other or the robot."""

from typing import Any

from legged.config.checks import shown
from legged.config.networks import groups_in, path_of_terms
from legged.config.randomization import draw_of
from legged.config.schema import LeggedConfig, RobotConfig
from legged.envs.checks import check_mirror_kinds
from legged.envs.privileged_terms import MIRROR_KINDS, PREFIX, observed
from legged.envs.randomization_checks import check_disturbances
from legged.errors import ConfigError
from legged.mdp.actuators.actuator import check_actuator
from legged.mdp.actuators.motor_curve import check_motor_model, check_slowest
from legged.mdp.control import acted_joints, action_scales, check_wheels, control_gains
from legged.mdp.mirror_images import mirror_of_actions
from legged.physics.fields import FIELDS
from legged.robots.robot import Robot
from legged.terrain import check_terrain

MOST_POINTS = 10_000
"""Largest number of points in the height scan."""


def check_legged(cls: Any, cfg: RobotConfig, robot: Robot) -> None:
    """Check a robot's settings, except those that `check_task` checks. `cls` is the task's class.

    Raises:
        ConfigError: a setting does not fit the robot or another setting.
    """
    if cfg.train.algorithm.symmetry:
        check_symmetry(cls, cfg, robot)
    control_gains(robot, cfg.control, cfg.origins.where)
    check_passive(cfg, robot)
    action_scales(robot, cfg.control, cfg.origins.where)
    check_wheels(robot, cfg.control, cfg.origins.where)
    check_actuator(robot, cfg.control, cfg.sim.dt, cfg.origins)
    check_motor_model(cfg.control.actuator, cfg.origins)
    if "velocity_limit" in cfg.domain_rand.ranges:
        lowest = draw_of(cfg.domain_rand.ranges["velocity_limit"]).range[0]
        check_slowest(robot, cfg.control, cfg.sim.dt, lowest, cfg.origins.where)
    check_terrain(cfg.terrain, cfg.origins)
    check_base_mass(cfg, robot)
    check_disturbances(cfg, robot)
    check_points(cfg)


def check_symmetry(cls: Any, cfg: RobotConfig, robot: Robot) -> None:
    """Check that robot, default pose, actions, observations and height scan have a mirror image.

    Raises:
        ConfigError: one of them has no mirror image.
    """
    origins = cfg.origins
    where, otherwise = (
        origins.where("train.algorithm.symmetry"),
        "set train.algorithm.symmetry=false to learn without mirror images",
    )
    if robot.mirror is None:
        raise ConfigError(f"{where}: left and right of '{robot.name}' are not symmetric (at zero joint angles); {otherwise}")
    uneven = robot.mirror.uneven_joint(robot.default_dof_pos)
    if uneven is not None:  # the observation `dof_pos` and the actions are relative to this pose, so it must be symmetric too
        partner = robot.mirror.joints[uneven]
        angles = ", ".join(f"{robot.joint_names[i]} {robot.default_dof_pos[i]:g} rad" for i in sorted({uneven, partner}))
        raise ConfigError(
            f"{where}: left and right default_joint_angles of '{robot.name}' are not symmetric ({angles}); {otherwise}"
        )
    acted = acted_joints(robot, cfg.control, origins.where)
    image = mirror_of_actions(robot.mirror, acted)
    if image is None:
        raise ConfigError(f"{origins.where('control.held')}: joints are held on one side only; {otherwise} ({where})")
    laws = robot.each(cfg.control.control_type, origins.where("control.control_type"))[list(acted)].tolist()
    scales = action_scales(robot, cfg.control, origins.where).tolist()
    for field, values in (("control_type", laws), ("action_scale", scales)):
        for i, partner in enumerate(image[0]):
            if values[i] != values[partner]:
                pair = ", ".join(f"{robot.joint_names[acted[k]]} {shown(values[k])}" for k in sorted((i, partner)))
                place = origins.where(f"control.{field}")
                raise ConfigError(f"{place}: left and right joints have different values ({pair}); {otherwise} ({where})")
    used = [term for group in groups_in(cfg).values() for term in group.terms]
    check_mirror_kinds(cls.__name__, cls.MIRRORED, used, where)
    for name in FIELDS:
        if f"{PREFIX}{name}" in used:
            check_mirrored_draw(cfg, robot, name)
    y = cfg.terrain.measured_points_y
    if sorted(y) != sorted(-value for value in y):
        points = f"terrain.measured_points_y ({origins.of('terrain.measured_points_y')})"
        raise ConfigError(f"{where}: {points} must be symmetric about 0, got {list(y)}")


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
        where = cfg.origins.where(f"domain_rand.{table}.{name}.each")
        what = f"numbers for each of the {FIELDS[name].what} have" if each else "one number for all joints has"
        raise ConfigError(
            f"{where}: {PREFIX}{name} is observed, and {what} no mirror image; set each to {str(not each).lower()}, or set"
            " train.algorithm.symmetry=false to learn without mirror images"
        )


def check_passive(cfg: RobotConfig, robot: Robot) -> None:
    """Check that passive joints are observed only if the robot has passive joints.

    Raises:
        ConfigError: passive joints are observed, but the robot has no passive joints.
    """
    names = ("passive_pos", "passive_vel")
    for group, terms in ((name, group.terms) for name, group in groups_in(cfg).items()):
        for term in terms:
            if term in names and (robot.passive is None or not robot.passive.names):
                where = cfg.origins.where(path_of_terms(cfg, group))
                raise ConfigError(f"{where}: {term}: '{robot.name}' has no passive hinges or slides (passive_joints)")


def check_base_mass(cfg: RobotConfig, robot: Robot) -> None:
    """Check that the lightest base that can be drawn has a positive mass.

    Raises:
        ConfigError: the mass is zero or negative.
    """
    lowest = cfg.domain_rand.added_mass_range[0]
    if cfg.domain_rand.randomize_base_mass and robot.base_mass + lowest <= 0.0:
        where, mass = cfg.origins.where("domain_rand.added_mass_range"), robot.base_mass
        raise ConfigError(
            f"{where}: the base of '{robot.name}' weighs {mass:.4g} kg, so the lowest added mass must be above {-mass:.4g},"
            f" got {lowest:g}"
        )


def check_points(cfg: RobotConfig) -> None:
    """Check that the height scan has at most MOST_POINTS points, so that it fits in memory.

    Raises:
        ConfigError: the scan has more points.
    """
    points = len(cfg.terrain.measured_points_x) * len(cfg.terrain.measured_points_y)
    if points > MOST_POINTS:
        raise ConfigError(
            f"{cfg.origins.where('terrain.measured_points_x')}: the height scan has {points:,} points"
            f" (measured_points_x times measured_points_y), more than {MOST_POINTS:,}"
        )


def check_grid(cfg: LeggedConfig) -> None:
    """Check that each axis of evaluation's grid of commands goes from low to high in positive steps.

    Raises:
        ConfigError: the low end of an axis is above the high end, or the step is not positive.
    """
    for axis in ("vx", "vy", "yaw"):
        low, high, step = getattr(cfg.evaluation, axis)
        if low > high or step <= 0.0:
            where = cfg.origins.where(f"evaluation.{axis}")
            raise ConfigError(f"{where}: expected [low, high, step] with low <= high and step > 0, got {[low, high, step]}")
