"""mujoco-warp behind the `Physics` interface, and the code that all engines on Warp share."""

from legged.physics import warp_settings

__all__ = ["warp_settings"]  # `warp_settings` must be imported before any module here declares a kernel
