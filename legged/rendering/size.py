"""How large a robot is, which says from how far it is looked at."""

from dataclasses import dataclass

import mujoco
import numpy as np

from legged.robots.importing.adapted import robot_spec_of
from legged.robots.robot import Robot


@dataclass(frozen=True)
class RobotSize:
    """The upright box around a robot in its default pose: ANYmal C's is 1.04 m long and 0.77 m high."""

    longest: float
    """Its longest side [m]."""
    height: float
    """[m]."""
    sides: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Along x, y and z [m]."""


def size_of(robot: Robot) -> RobotSize:
    """Measure the shapes of a robot, seen or touched."""
    return size_of_model(robot_spec_of(robot.model_path).compile(), robot.default_qpos)


def size_of_model(model: mujoco.MjModel, qpos: np.ndarray) -> RobotSize:
    """Measure the shapes of all bodies of a model but its world, at the positions `qpos` (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    own = [i for i in range(model.ngeom) if model.geom_bodyid[i] > 0 and model.geom_type[i] != mujoco.mjtGeom.mjGEOM_PLANE]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    points = [
        data.geom_xpos[i] + (model.geom_aabb[i, :3] + corners * model.geom_aabb[i, 3:]) @ data.geom_xmat[i].reshape(3, 3).T
        for i in own
    ]
    sides = np.ptp(np.concatenate(points), axis=0)
    return RobotSize(float(sides.max()), float(sides[2]), tuple(sides.tolist()))
