"""Which camera draws a task."""

from legged.envs import BaseTask, LeggedRobot
from legged.rendering.model_camera import ModelCamera
from legged.rendering.robots_camera import RobotsCamera


def camera_of(task: BaseTask, count: int = 1, width: int = 960, height: int = 540) -> ModelCamera | RobotsCamera:
    """Return what draws a task in pictures of that size [pixels]: of legged robots, the first `count` of them.

    Raises:
        RunError: nothing can be rendered.
    """
    if isinstance(task, LeggedRobot):
        return RobotsCamera(task, count, width, height)
    return ModelCamera(task, width, height)
