"""Pictures of robots and terrain."""

from legged.rendering.camera import Camera, make_renderer, window_opens
from legged.rendering.framing import RobotSize, size_of
from legged.rendering.scene import add_sky, display_model
from legged.rendering.task_cameras import ModelCamera, RobotsCamera, camera_of, drawn_model, follow_root

__all__ = [
    "Camera",
    "ModelCamera",
    "RobotSize",
    "RobotsCamera",
    "add_sky",
    "camera_of",
    "display_model",
    "drawn_model",
    "follow_root",
    "make_renderer",
    "size_of",
    "window_opens",
]
