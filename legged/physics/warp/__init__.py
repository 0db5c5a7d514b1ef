"""mujoco-warp behind the `Physics` interface, and the code that all engines on Warp share."""

from legged.physics.warp import settings

__all__ = ["settings"]  # `settings` must be imported before any module here declares a kernel
