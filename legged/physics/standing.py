"""Test of PD gains by the height at which a robot stands in C MuJoCo."""

import mujoco
import numpy as np

from legged.config.world import SimConfig
from legged.physics.scene import RobotScene
from legged.robots.robot import Robot

SECONDS = 2.0
"""Time that a robot is given to come to rest [s]."""
FEWEST_FEET = 3
"""Least number of feet on which a robot stands without balancing. A robot with fewer feet is kept level and in place."""
COSTLY_CONTACTS = {"cone": "elliptic", "impratio": 100.0}
"""Contact settings with which loaded feet do not creep."""


def height_under_gains(robot: Robot, stiffness: np.ndarray, damping: np.ndarray) -> float:
    """Simulate a robot on a plane for two seconds. PD control with the gains `stiffness` and `damping` (D,) holds the default
    pose. Return the final height of the base [m], or 0 if the motion diverges. A wheel's stiffness is a gain on its speed.
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
    # When a motion diverges, MuJoCo resets the state and the time.
    calm = np.isfinite(data.qpos).all() and data.time > 0.9 * SECONDS
    return float(data.qpos[2]) if calm else 0.0
