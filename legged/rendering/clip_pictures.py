"""Pictures of a clip: a robot that replays a reference motion."""

from collections.abc import Iterator
from contextlib import closing

import mujoco
import numpy as np

from legged.motion.clip import Clip
from legged.rendering.camera import Camera, caption, size_of
from legged.rendering.scene import display_model
from legged.robots.robot import Robot

SIZE = 640, 480
"""Width and height of a picture [pixels]."""
DISTANCE, ELEVATION = 2.2, -12.0
"""Distance of the camera in lengths of the robot, and its elevation [degrees]."""
GLIDE = 0.08
"""Share of its distance to the robot that the point in the camera's centre moves in each picture."""


def pictures_of(clip: Clip, robot: Robot, every: int = 1) -> Iterator[np.ndarray]:
    """Yield a picture (height, width, 3) uint8 of every `every`-th frame.

    Raises:
        RunError: this machine cannot render.
    """
    with closing(Camera(display_model(robot, 1, *SIZE), *SIZE)) as camera:
        view, joints = camera.view, [camera.model.joint(f"0/{name}").qposadr[0] for name in robot.joint_names]
        view.type, view.distance = mujoco.mjtCamera.mjCAMERA_FREE, DISTANCE * float(size_of(robot).max())
        view.azimuth, view.elevation = 130.0, ELEVATION
        view.lookat[:] = [*clip.root_pos[0, :2], 0.5 * robot.height]
        camera.data.qpos[:] = robot.default_qpos
        for frame in range(0, len(clip), every):
            camera.data.qpos[:3], camera.data.qpos[3:7] = clip.root_pos[frame], clip.root_quat[frame]
            camera.data.qpos[joints] = clip.joint_pos[frame]
            view.lookat[:2] += GLIDE * (clip.root_pos[frame, :2] - view.lookat[:2])
            camera.update()
            yield caption(camera.render(), [clip.name, f"{frame / clip.fps:.2f} s, frame {frame}"])
