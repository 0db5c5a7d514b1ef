"""Robots: names, indices, limits and gains, read from a robot folder (robot.yaml and MJCF)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from legged.config.bounds import LARGEST, NAMES, TERMS, between, positive
from legged.config.checks import build, shown
from legged.config.yaml_files import read_yaml
from legged.errors import ConfigError, suggest
from legged.process.paths import data_folder, exists
from legged.robots.gains import VELOCITY_LIMIT, gains, inertia_in_air
from legged.robots.importing.convert import adaptations
from legged.robots.mirror import Mirror
from legged.robots.passive_joints import PassiveJoints, default_qpos
from legged.robots.patterns import match_names, match_values
from legged.robots.robot_model import aimless_shapes, base_mass, check_model, driven_joints, passive_joints, read_model
from legged.robots.shapes import Shapes, self_collision_shapes
from legged.robots.stance import standing_height, swinging_joints

SLACK = 1e-3
"""A default angle may be this far outside the range of its joint, because angles are rounded [rad]."""


@dataclass(frozen=True)
class RobotFile:
    """The schema of robot.yaml."""

    model: str
    """MJCF file in the same folder."""
    base: str
    """Name of the floating body."""
    spawn_height: float = field(metadata=positive(100, low=1e-3))
    """Base height above the ground after a reset [m]."""
    default_joint_angles: dict[str, float] = field(metadata=between(-100, 100))
    """Joint-name pattern -> angle at action 0 [rad]."""
    feet: tuple[str, ...] = field(metadata=NAMES)
    """Patterns of the feet's shapes. All of these shapes on one body form one foot."""
    stiffness: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Joint-name pattern -> P gain [N m/rad]; if the table is empty, gains.py computes the gains from inertia and weight."""
    damping: dict[str, float] = field(default_factory=dict, metadata=between(0, LARGEST))
    """Joint-name pattern -> D gain [N m s/rad]; if the table is empty, gains.py computes the gains."""
    velocity_limit: dict[str, float] = field(default_factory=dict, metadata=positive(LARGEST))
    """Joint-name pattern -> largest joint speed [rad/s]; an empty table means 30 for all joints."""
    penalize_contacts_on: tuple[str, ...] = ()
    """Patterns of the shapes whose contacts the `collision` reward counts."""
    terminate_after_contacts_on: tuple[str, ...] = ()
    """Patterns of the shapes whose contact ends the episode."""
    self_collision_shapes: tuple[str, ...] = ()
    """Patterns of shapes that collide only with `sim.self_collisions`. In the model, their contype and conaffinity are 0."""
    passive_joints: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Patterns of the joints without a motor, e.g. of springs and closed loops. Slides and balls are allowed."""
    wheels: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Patterns of the joints that turn wheels. Their angles have no meaning: they are neither observed nor rewarded."""


@dataclass(frozen=True)
class Robot:
    """A robot's properties, as tasks use them. The robot has D joints with a motor (in the order of the model), P passive
    hinges and slides, S collision shapes, F feet and B contacts. "Joint" means a joint with a motor unless stated otherwise.

    A "contact" is one collision shape, or all shapes of a foot together. One contact force is computed for each contact.
    """

    name: str
    folder: Path
    file: RobotFile
    joint_names: tuple[str, ...]
    default_dof_pos: np.ndarray
    """(D,) joint angles at action 0 [rad]."""
    dof_pos_limits: np.ndarray
    """(D, 2) lower and upper limits of joint angles [rad]; infinite for joints without a range."""
    dof_vel_limits: np.ndarray
    """(D,) largest joint speeds [rad/s]."""
    torque_limits: np.ndarray
    """(D,) largest motor torques [N m]."""
    stiffness: np.ndarray
    """(D,) P gains [N m/rad]; `damping` (D,) are D gains [N m s/rad]. The gains of a wheel act on speed and acceleration."""
    damping: np.ndarray
    armature: np.ndarray
    """(D,) inertia of rotor and gear, reflected to the joint [kg m^2]."""
    inertia: np.ndarray
    """(D,) inertia that each motor turns while the robot is in the air in its default pose [kg m^2]."""
    wheels: np.ndarray
    """(D,) True if the joint turns a wheel."""
    swings: np.ndarray
    """(D,) True if the joint swings a leg forward and back in the default pose."""
    height: float
    """Height of the base above the ground when the robot stands level in its default pose [m]."""
    qpos_columns: tuple[int, ...]
    """(D,) column of each joint in MuJoCo's generalised positions; `qvel_columns` are the columns in the velocities."""
    qvel_columns: tuple[int, ...]
    passive: PassiveJoints | None
    """Joints without a motor; None if every joint has a motor."""
    default_qpos: np.ndarray
    """(nq,) MuJoCo's generalised positions at action 0, for a level base at the origin. Springs and loops determine the
    positions of the passive joints.
    """
    shape_names: tuple[str, ...]
    """Names of the S collision shapes, in the order of the model. `shape_bodies` are the names of their bodies."""
    shape_bodies: tuple[str, ...]
    self_collision_shapes: Mapping[str, str]
    """Name of each shape that collides only with `sim.self_collisions` -> name of its body. No contact force is computed for
    it, and it is not among the S shapes."""
    contact_of_shape: tuple[int, ...]
    """(S,) index of the contact that each shape belongs to."""
    contact_names: tuple[str, ...]
    """Names of the B contacts: the shape's name or, for a foot of several shapes, the common beginning of their names."""
    feet_shapes: tuple[tuple[str, ...], ...]
    """(F,) names of the shapes of each foot."""
    feet_indices: tuple[int, ...]
    """(F,) indices of the feet among the contacts. `penalised_indices` are those of the contacts that the `collision`
    reward counts, and `termination_indices` those of the contacts that end an episode.
    """
    penalised_indices: tuple[int, ...]
    termination_indices: tuple[int, ...]
    mass: float
    """Total mass [kg]."""
    base_mass: float
    """Mass of the floating body [kg]."""
    adaptations: tuple[str, ...]
    """One line for each change that was made to the model for the engines."""
    mirror: Mirror | None
    """Left and right partners of joints and feet; None if the robot is not symmetric."""

    @property
    def num_dof(self) -> int:
        return len(self.joint_names)

    @property
    def feet_names(self) -> tuple[str, ...]:
        return tuple(self.contact_names[i] for i in self.feet_indices)

    @property
    def model_path(self) -> Path:
        return self.folder / self.file.model

    @property
    def without_wheels(self) -> tuple[int, ...]:
        """Indices of the joints that do not turn wheels."""
        return tuple(int(i) for i in np.flatnonzero(~self.wheels))

    def colliding(self, self_collisions: bool) -> dict[str, str]:
        """Return name -> body of the shapes that collide with or without `sim.self_collisions`."""
        always = dict(zip(self.shape_names, self.shape_bodies, strict=True))
        return always | dict(self.self_collision_shapes) if self_collisions else always

    def each(self, value: Any, where: str) -> np.ndarray:
        """Return a number for each joint (D,). `value` is one number for all, or maps patterns of joint names to numbers.

        Raises:
            ConfigError: a pattern matches no joint, or no pattern matches a joint.
        """
        table = isinstance(value, Mapping)
        return match_values(value, self.joint_names, where) if table else np.full(self.num_dof, value)

    def with_armature(self, armature: np.ndarray) -> "Robot":
        """Return the same robot with other rotor inertias `armature` (D,) [kg m^2]. The `inertia` of a joint changes as much
        as its own rotor inertia. The small effect of the other joints' rotors is neglected.
        """
        return replace(self, armature=armature, inertia=self.inertia + armature - self.armature)


def load_robot(name: str, where: str = "robot") -> Robot:
    """Return the robot in resources/robots/`name` or, without such a folder, in the folder with the path `name`. `where` is
    the place of the name in the configuration, for error messages.

    Raises:
        ConfigError: there is no such robot, or robot.yaml and the model contradict each other.
    """
    folder = _folder(name, where)
    path = folder / "robot.yaml"
    data = read_yaml(path)
    missing = [k for k in ("model", "base", "spawn_height", "default_joint_angles", "feet") if k not in data]
    missing += [k for k, other in (("stiffness", "damping"), ("damping", "stiffness")) if other in data and k not in data]
    if missing:
        raise ConfigError(f"{path}: missing: {', '.join(missing)}")
    file = build(RobotFile, data, str(path))
    model = read_model(folder, file.model, str(path))
    check_model(model, file.base, str(path), file.passive_joints)
    undriven = passive_joints(model, file.passive_joints, str(path))
    joints = [model.joint(i) for i in driven_joints(model, undriven)]
    names = tuple(joint.name for joint in joints)
    default = match_values(file.default_joint_angles, names, f"{path}: default_joint_angles")
    limits = np.array([j.range if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in joints], dtype=float)
    for name, angle, (low, high) in zip(names, default, limits, strict=True):
        if not low - SLACK <= angle <= high + SLACK:
            told = f"{angle:g} rad for '{name}' is outside its range, {low:g} to {high:g} rad"
            raise ConfigError(f"{path}: default_joint_angles: {told}")
    numbers = [joint.id for joint in joints]
    passive = PassiveJoints.of(model, numbers, undriven) if undriven else None
    shapes = Shapes.of(model, file.feet, f"{path}: feet")
    foot_ids = [model.geom(name).id for foot in shapes.feet_shapes for name in foot]
    qpos = default_qpos(model, numbers, default, passive, f"{path}: default_joint_angles")
    height, torque_limits = standing_height(model, file.base, qpos), model.actuator_forcerange[:, 1].copy()
    wheels = np.isin(np.arange(len(names)), match_names(file.wheels, names, f"{path}: wheels"))
    if file.velocity_limit:
        velocity_limits = match_values(file.velocity_limit, names, f"{path}: velocity_limit")
    else:
        velocity_limits = np.full(len(names), VELOCITY_LIMIT)
    if file.stiffness or file.damping:
        stiffness = match_values(file.stiffness, names, f"{path}: stiffness")
        damping = match_values(file.damping, names, f"{path}: damping")
    else:
        stiffness, damping = gains(model, qpos, numbers, foot_ids, torque_limits, height, wheels * velocity_limits)
    return Robot(
        name=folder.name,
        folder=folder,
        file=file,
        joint_names=names,
        default_dof_pos=default,
        dof_pos_limits=limits,
        dof_vel_limits=velocity_limits,
        torque_limits=torque_limits,
        stiffness=stiffness,
        damping=damping,
        armature=model.dof_armature[[int(joint.dofadr[0]) for joint in joints]],
        inertia=inertia_in_air(model, qpos, numbers),
        wheels=wheels,
        swings=swinging_joints(model, qpos, numbers, foot_ids),
        height=height,
        qpos_columns=tuple(int(joint.qposadr[0]) for joint in joints),
        qvel_columns=tuple(int(joint.dofadr[0]) for joint in joints),
        passive=passive,
        default_qpos=qpos,
        shape_names=shapes.names,
        shape_bodies=shapes.bodies,
        self_collision_shapes=self_collision_shapes(model, file.self_collision_shapes, f"{path}: self_collision_shapes"),
        contact_of_shape=shapes.contact,
        contact_names=shapes.contact_names,
        feet_shapes=shapes.feet_shapes,
        feet_indices=shapes.feet,
        penalised_indices=shapes.contacts(file.penalize_contacts_on, f"{path}: penalize_contacts_on"),
        termination_indices=shapes.contacts(file.terminate_after_contacts_on, f"{path}: terminate_after_contacts_on"),
        mass=float(model.body_mass.sum()),
        base_mass=base_mass(model, file.base),
        adaptations=(*adaptations(folder / file.model), *aimless_shapes(model)),
        mirror=Mirror.of(model, numbers, shapes.feet_shapes, passive.numbers if passive else ()),
    )


def _folder(name: str, where: str) -> Path:
    robots = data_folder("resources") / "robots"
    known = suggest(name, [p.parent.name for p in robots.glob("*/robot.yaml")])
    if not name:
        raise ConfigError(f"{where}: the name of the robot is empty{known}")
    for folder in (robots / name, Path(name)):
        if exists(folder / "robot.yaml"):
            return folder.resolve()
    if len(Path(name).parts) > 1:  # the path may be from a run on another machine
        raise ConfigError(
            f"{where}: there is no robot {shown(name)}, because that folder has no robot.yaml. "
            "If the robot was moved, give its new folder: robot=FOLDER"
        )
    raise ConfigError(f"{where}: there is no robot {shown(name)}{known}")
