"""Crouched pose that a fallen robot takes before it stands up. The feet are pulled below the base."""

import numpy as np

from legged.robots.robot import Robot
from legged.robots.robot_model import read_model
from legged.robots.stance import standing_height

CROUCH = 0.55
"""Height of the base in the crouched pose, as a share of its height in the default pose."""
FACTORS = np.arange(1.0, 4.0, 0.05)
"""Factors on the default angles of the joints that swing legs. They are tried in this order."""
FEWEST_FEET = 4
"""Least number of feet; with fewer feet a crouching robot may fall."""


def crouch(robot: Robot) -> np.ndarray | None:
    """Return joint angles (D,) [rad] of a crouched pose, in which the base is at most `CROUCH` times as high as in the
    default pose.

    The default angles of joints that swing legs are multiplied by one common factor and clipped to the joints' limits. Other
    joints keep their default angles. Return None for a robot with fewer than four feet, with passive joints, or with legs
    that do not bend so far.
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
