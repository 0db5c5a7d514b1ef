"""Pictures of robots and terrain."""

from legged.rendering.camera import Camera
from legged.rendering.camera_of import camera_of
from legged.rendering.model_camera import ModelCamera, drawn_model, follow_root
from legged.rendering.robots_camera import RobotsCamera
from legged.rendering.scene import add_sky, display_model, make_renderer
from legged.rendering.size import RobotSize, size_of
from legged.rendering.window import window_opens

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
