"""A crouched pose, in which a fallen robot pulls its feet below the base before it stands up."""

import numpy as np

from legged.robots.robot import Robot
from legged.robots.robot_model import read_model
from legged.robots.stance import standing_height

CROUCH = 0.55
"""Height of the base in the crouched pose, as a share of its height in the default pose."""
FACTORS = np.arange(1.0, 4.0, 0.05)
"""Factors on the default angles of the joints that swing legs, tried in this order."""
FEWEST_FEET = 4
"""Least number of feet; with fewer a crouching robot may fall."""


def crouch(robot: Robot) -> np.ndarray | None:
    """Return joint angles (D,) [rad] at which a robot stands on its feet with its base at most `CROUCH` times its default
    height above the ground.

    The angles are those of the default pose, with all joints that swing legs multiplied by one factor, within their limits.
    Return None for a robot with fewer than four feet, with passive joints, or with legs that do not bend so far.
    """
    if robot.passive is not None or len(robot.feet_indices) < FEWEST_FEET:
        return None
    model = read_model(robot.folder, robot.file.model, str(robot.folder))
    for factor in FACTORS:
        bent = np.where(robot.swings, factor * robot.default_dof_pos, robot.default_dof_pos)
        angles = np.clip(bent, *robot.dof_pos_limits.T)
        qpos = robot.default_qpos.copy()
        qpos[list(robot.qpos_columns)] = angles
        if standing_height(model, robot.file.base, qpos) <= CROUCH * robot.height:
            return np.asarray(angles)
    return None
