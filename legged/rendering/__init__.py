"""Pictures of robots and terrain."""

from legged.rendering.camera import Camera
from legged.rendering.scene import add_sky, display_model, make_renderer

__all__ = ["Camera", "add_sky", "display_model", "make_renderer"]
