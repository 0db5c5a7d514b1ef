"""Robots in the league: this package's G1 with the masses, motors and feet of the league's model, and other humanoids."""

from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import Any

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.evaluation.league.protocol import Arm
from legged.robots.importing.convert import robot_spec_of
from legged.robots.robot import Robot, load_robot

OURS = "g1"
"""Name of the robot from which the league's own robot is made."""
BODIES = {  # numbers of `g1_29dof.xml` in unitree_mujoco
    "waist_yaw_link": (
        *(0.244, (0.003964, 0.0, 0.018769), (-0.0178291, 0.628464, 0.0282471, 0.777121)),
        (0.000158561, 0.000124229, 9.67669e-05),
    ),
    "waist_roll_link": (
        *(0.047, (0.0, -0.000236, 0.010111), (0.99979, 0.020492, 0.0, 0.0)),
        (7.515e-06, 6.40206e-06, 3.98394e-06),
    ),
    "torso_link": (
        *(9.598, (0.00331658, 0.000261533, 0.179856), (0.999831, 0.000376204, 0.0179895, -0.00377704)),
        (0.12407, 0.111951, 0.0325382),
    ),
}
"""Body -> mass [kg], centre of mass [m], orientation of its principal axes (w, x, y, z), principal inertias [kg m^2]."""
PLACES = {"waist_roll_link": (-0.0039635, 0.0, 0.035), "torso_link": (0.0, 0.0, 0.019)}
"""Body -> position in the frame of its parent [m]."""
RAISED = 0.01
"""Height of the league's torso frame above ours [m]. What is on the torso is lowered by this."""
ARMATURE = {
    **dict.fromkeys(("hip_pitch", "hip_roll", "knee"), 0.0251),
    **dict.fromkeys(("hip_yaw", "waist_yaw"), 0.01018),
    **dict.fromkeys(("ankle", "waist_roll", "waist_pitch"), 0.00722),
    **dict.fromkeys(("shoulder", "elbow", "wrist_roll"), 0.00361),
    **dict.fromkeys(("wrist_pitch", "wrist_yaw"), 0.00425),
}
"""Joint-name pattern -> inertia of rotor and gear [kg m^2]."""
TORQUE = {
    **dict.fromkeys(("hip", "waist_yaw"), 88.0),
    "knee": 139.0,
    **dict.fromkeys(("ankle", "waist_roll", "waist_pitch"), 50.0),
    **dict.fromkeys(("shoulder", "elbow", "wrist_roll"), 25.0),
    **dict.fromkeys(("wrist_pitch", "wrist_yaw"), 5.0),
}
"""Joint-name pattern -> largest torque [N m]."""
RESISTANCE = 0.01
"""Damping [N m s/rad] and dry friction [N m] of every joint."""
SOLE = ((-0.05, 0.025), (-0.05, -0.025), (0.12, 0.03), (0.12, -0.03))
"""Places of a foot's spheres, x and y in the frame of the ankle [m]. They are 0.03 m below it."""
RADIUS = 0.005
"""Radius of these spheres [m]."""
CRANE_HEIGHT = 0.793
"""Height of the pelvis at which the league's crane lets go of the robot [m]."""
PULSE = 2.0 * np.pi * 10.0
"""Angular frequency of the league's own servos with the motor's inertia alone [rad/s]."""
ARM_LINKS = (  # of `g1_29dof.xml` in unitree_mujoco; this package's G1 has the same arm to within 3e-4 rad
    ((0.0039563, 0.10022, 0.23778), (0.990264, 0.139201, 1.38722e-05, -9.86868e-05), (0.0, 1.0, 0.0)),
    ((0.0, 0.038, -0.013831), (0.990268, -0.139172, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ((0.0, 0.00624, -0.1032), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.015783, 0.0, -0.080518), (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.1, 0.00188791, -0.01), (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ((0.038, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.046, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
)
"""Links of the league's left arm, as in `Arm`."""
HAND = np.array([(x, y, z) for x in (0.0, 0.13182935) for y in (-0.04790606, 0.01865148) for z in (-0.0430289, 0.0634499)])
"""Corners of the left rubber hand's box, where the league puts it in the frame of the last link [m]."""
HEAD = 0.32479587 - 0.054
"""Height of the lower end of the head's mesh in the frame of the league's torso [m]."""


@dataclass(frozen=True)
class Humanoid:
    """Properties of a robot in the league."""

    hand: Any
    """(C, 3) points of the left hand in the frame of the arm's last link [m]."""
    head: float
    """Height of the lower end of the head in the frame of the torso [m]."""
    arm_links: Any = None
    """Links of the left arm, as in `Arm`. None: those of the robot's model."""
    height: float | None = None
    """Height of the base at the start [m]. None: the robot's spawn height. The joints are at rest at the default angles."""
    is_the_leagues: bool = False
    """True: the model and the gains of held arms are the league's. False: they are the robot's and the policy's."""


HUMANOIDS = {
    OURS: Humanoid(HAND, HEAD, ARM_LINKS, CRANE_HEIGHT, is_the_leagues=True),
    "h1": Humanoid(hand=((0.31, 0.0, -0.0166),), head=0.56),  # the end of the forearm's capsule
}
"""Name of a robot -> what is its own in the league."""
ARM_PARTS = ("shoulder", "elbow", "wrist")
"""Parts of the names of the arms' joints."""


def league_robot(name: str, parent: Path) -> Robot:
    """Return the robot of this name in HUMANOIDS, as the league's runs simulate it. Its files may be in `parent`."""
    return load_robot(str(write_robot(parent)) if HUMANOIDS[name].is_the_leagues else name)


def check_robot(robot: Robot, task: str) -> None:
    """Check that the league has runs for the robot of `task`.

    Raises:
        ConfigError: the robot is not in HUMANOIDS, or not this package's.
    """
    if robot.name not in HUMANOIDS or robot.folder != load_robot(robot.name).folder:
        known = " and ".join(f"'{name}'" for name in HUMANOIDS)
        raise ConfigError(f"POLICY: the league measures this package's {known}, but '{task}' has '{robot.name}'")


def arms_of(robot: Robot) -> tuple[list[int], list[int]]:
    """Return the indices of the joints of the left arm, and of their partners in the right arm."""
    assert robot.mirror is not None
    names = enumerate(robot.joint_names)
    left = [i for i, name in names if name.startswith("left") and any(part in name for part in ARM_PARTS)]
    return left, [robot.mirror.joints[i] for i in left]


def arm_of(robot: Robot) -> Arm:
    """Return the left arm of a robot."""
    own, (left, _) = HUMANOIDS[robot.name], arms_of(robot)
    links = own.arm_links
    if links is None:
        model = robot_spec_of(robot.model_path).compile()
        joints = [model.joint(robot.joint_names[i]) for i in left]
        links = [(model.body_pos[body], model.body_quat[body], joint.axis) for joint in joints for body in joint.bodyid]
    return Arm(robot.default_dof_pos[left], robot.dof_pos_limits[left], links, np.array(own.hand), own.head)


def write_robot(parent: Path) -> Path:
    """Write the league's robot to a new folder in `parent`, and return the folder. `load_robot` reads it."""
    folder = parent / OURS
    folder.mkdir()
    ours = load_robot(OURS)
    copyfile(ours.folder / "robot.yaml", folder / "robot.yaml")
    spec = robot_spec_of(ours.model_path)
    for name, (mass, centre, turn, inertia) in BODIES.items():
        body = spec.body(name)
        body.mass, body.ipos, body.iquat, body.inertia = mass, centre, turn, inertia
        body.fullinertia = [np.nan] * 6
    for name, place in PLACES.items():
        spec.body(name).pos = place
    for part in (*spec.body("torso_link").geoms, *spec.body("torso_link").bodies):
        if isinstance(part, mujoco.MjsGeom) and np.isfinite(part.fromto).all():
            part.fromto = part.fromto - np.array([0.0, 0.0, RAISED] * 2)
        else:
            part.pos = part.pos - np.array([0.0, 0.0, RAISED])
    armature, torque = ours.each(ARMATURE, "armature"), ours.each(TORQUE, "torque")
    for name, inertia, most in zip(ours.joint_names, armature, torque, strict=True):
        joint, motor = spec.joint(name), next(motor for motor in spec.actuators if motor.target == name)
        joint.armature, joint.frictionloss, joint.damping = inertia, RESISTANCE, np.array([RESISTANCE, 0.0, 0.0])
        motor.forcerange = motor.ctrlrange = (-most, most)
    for side in ("left", "right"):
        body = spec.body(f"{side}_ankle_roll_link")
        old = next(geom for geom in body.geoms if geom.name.startswith(f"{side}_foot"))
        touch = {name: getattr(old, name) for name in ("contype", "conaffinity", "condim", "friction", "priority", "group")}
        for geom in [geom for geom in body.geoms if geom.name.startswith(f"{side}_foot")]:
            spec.delete(geom)
        for number, (x, y) in enumerate(SOLE):
            sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [RADIUS, 0.0, 0.0], "pos": [x, y, -0.03]}
            body.add_geom(name=f"{side}_foot_{number}", **sphere, **touch)
    spec.compile()
    (folder / ours.file.model).write_text(spec.to_xml(), encoding="utf-8")
    return folder


def servo_gains(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains of the league's own servos, (D,) each [N m/rad, N m s/rad]: 10 Hz, and a damping ratio of 2."""
    return robot.armature * PULSE**2, 4.0 * robot.armature * PULSE
