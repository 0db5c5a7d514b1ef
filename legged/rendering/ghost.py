"""Ghosts: translucent robots that show what robots should reach."""

import mujoco
import numpy as np

from legged.envs.motion_tracking import MotionTracking

GHOST = (0.10, 0.75, 0.25, 0.25)
"""Colour of a ghost, that of commands: red, green, blue and opacity, 0 to 1."""


class Ghost:
    """References of robots in a scene that is drawn: a translucent copy of each robot in the pose of its reference."""

    def __init__(self, task: MotionTracking, model: mujoco.MjModel) -> None:
        """Show the references of `task`. `model` has the drawn robots, one after the other."""
        self.task, self.model, self.data = task, model, mujoco.MjData(model)

    def draw(self, scene: mujoco.MjvScene, options: mujoco.MjvOption, first: int, offsets: np.ndarray) -> None:
        """Add the references of K robots, from number `first` on, to `scene`. Each is shifted by its row of `offsets` (K, 3),
        world frame [m].
        """
        poses, count = self.data.qpos.reshape(len(offsets), -1), scene.ngeom
        poses[:] = self.task.motion.now.qpos[first : first + len(offsets)].cpu().numpy()
        poses[:, :3] += offsets
        mujoco.mj_kinematics(self.model, self.data)
        moved = mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mjv_addGeoms(self.model, self.data, options, mujoco.MjvPerturb(), moved, scene)
        for geom in scene.geoms[count : scene.ngeom]:
            geom.rgba, geom.matid = GHOST, -1
