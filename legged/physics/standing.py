"""Test of gains: the height at which a robot stands under them in C MuJoCo."""

import mujoco
import numpy as np

from legged.config.schema import SimConfig
from legged.physics.scene import RobotScene
from legged.robots.robot import Robot

SECONDS = 2.0
"""Time that a robot is given to come to rest [s]."""
FEWEST_FEET = 3
"""Least number of feet on which a robot can stand without balancing; one with fewer is kept level and in place."""
COSTLY_CONTACTS = {"cone": "elliptic", "impratio": 100.0}
"""Settings with which feet do not creep."""


def height_under_gains(robot: Robot, stiffness: np.ndarray, damping: np.ndarray) -> float:
    """Return the height of the base [m] after two seconds in the default pose, on a plane, under gains (D,) of an explicit
    law; 0 if the motion grows without limits. Wheels are braked by their gains on speed.
    """
    sim = SimConfig(**COSTLY_CONTACTS)  # type: ignore[arg-type]
    model = RobotScene(robot).model(sim)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    data.qpos[2] = robot.height + 1e-3
    columns, speeds = list(robot.qpos_columns), list(robot.qvel_columns)
    p, d = np.where(robot.wheels, 0.0, stiffness), np.where(robot.wheels, stiffness, damping)
    for _ in range(round(SECONDS / sim.dt)):
        asked = p * (robot.default_dof_pos - data.qpos[columns]) - d * data.qvel[speeds]
        data.ctrl[:] = np.clip(asked, -robot.torque_limits, robot.torque_limits)
        mujoco.mj_step(model, data)
        if len(robot.feet_indices) < FEWEST_FEET:
            data.qpos[[0, 1, 3, 4, 5, 6]], data.qvel[[0, 1, 3, 4, 5]] = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], 0.0
    calm = np.isfinite(data.qpos).all() and data.time > 0.9 * SECONDS  # MuJoCo starts anew when a motion diverges
    return float(data.qpos[2]) if calm else 0.0
