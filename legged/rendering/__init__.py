"""Pictures of robots and terrain."""

from legged.rendering.camera import Camera
from legged.rendering.scene import add_sky, display_model, make_renderer
from legged.rendering.size import RobotSize, size_of
from legged.rendering.window import window_opens

__all__ = ["Camera", "RobotSize", "add_sky", "display_model", "make_renderer", "size_of", "window_opens"]
