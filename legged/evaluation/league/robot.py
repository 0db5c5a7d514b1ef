"""The league's robot: this package's G1 with the masses, motors and feet of the league's model."""

from pathlib import Path
from shutil import copyfile

import mujoco
import numpy as np

from legged.robots.importing.convert import robot_spec_of
from legged.robots.robot import Robot, load_robot

OURS = "g1"
"""Name of the robot from which the league's robot is made."""
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
PULSE = 2.0 * np.pi * 10.0
"""Angular frequency of the league's own servos with the motor's inertia alone [rad/s]."""


def write_robot(parent: Path) -> Path:
    """Write the league's robot to a new folder in `parent`, and return the folder. `load_robot` reads it."""
    folder = parent / f"{OURS}_league"
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
