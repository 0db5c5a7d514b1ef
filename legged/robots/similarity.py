"""How large a robot is, and what that makes of numbers that were written for another one.

Bodies of different size move alike where lengths grow by h, times by sqrt(h / g), masses by m, and so speeds by sqrt(g h),
forces by m g and torques by m g h: dynamic similarity (Alexander and Jayes, J. Zool. 201, 1983). Here m is the robot's mass
and h its standing height; gravity is the same for all.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from legged.config.units import factor
from legged.robots.robot import load_robot

FAR = 100.0
"""How far below the base the ground is put to measure the distance to it [m]."""


@dataclass(frozen=True)
class Size:
    """What the size of a robot is."""

    mass: float
    """Total mass [kg]."""
    height: float
    """Base above the ground when the robot stands level in its default pose [m]."""


def size_of(name: str, where: str = "robot") -> Size:
    """Return the size of the robot that `load_robot` knows by this name.

    Raises:
        ConfigError: it cannot be loaded.
    """
    robot = load_robot(name, where)
    return _size(str(robot.model_path), robot.file.base, robot.joint_names, tuple(robot.default_dof_pos), robot.mass)


@cache
def _size(path: str, base: str, joints: tuple[str, ...], angles: tuple[float, ...], mass: float) -> Size:
    return Size(mass, standing_height(Path(path), base, dict(zip(joints, angles, strict=True))))


def standing_height(model_path: Path, base: str, angles: dict[str, float]) -> float:
    """Return how far the base is above the lowest point of its collision shapes [m], level, at joint `angles` [rad]."""
    spec = mujoco.MjSpec.from_file(str(model_path))
    ground = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, -FAR], name="below it all")
    ground.contype = ground.conaffinity = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    for name, angle in angles.items():
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    shapes = [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
    below = [mujoco.mj_geomDistance(model, data, model.geom("below it all").id, i, 2.0 * FAR, None) for i in shapes]
    return float(FAR - min(below) + data.body(base).xpos[2])


def growth(written_for: Size, robot: Size) -> dict[str, float]:
    """Return by what masses ("kg"), lengths ("m") and times ("s") grow from one robot to another."""
    length = robot.height / written_for.height
    return {"kg": robot.mass / written_for.mass, "m": length, "s": float(np.sqrt(length))}


def grown(unit: str, written_for: Size, robot: Size) -> float:
    """Return by what a quantity of that unit, as "m/s" or "N^2 m^2", grows from one robot to another."""
    return factor(unit, growth(written_for, robot))
