"""A pose from which a robot that lies anyhow stands up: legs bent so far that its feet are below it before they carry it."""

import numpy as np

from legged.robots.robot import Robot
from legged.robots.robot_model import read_model
from legged.robots.stance import standing_height

CROUCH = 0.55
"""Height of the base in that pose, as a share of its height in the default pose."""
FACTORS = np.arange(1.0, 4.0, 0.05)
"""Times the default angles, of joints that swing legs."""
FEWEST_FEET = 4
"""With fewer a robot that crouches may fall."""


def crouch(robot: Robot) -> np.ndarray | None:
    """Return joint angles (D,) [rad] at which a robot stands on its feet with the base as low as `CROUCH` says: those of the
    default pose, those that swing legs all bent by one factor, within their limits. None for a robot with fewer than four
    feet, with passive joints, or whose legs do not bend so far.
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
