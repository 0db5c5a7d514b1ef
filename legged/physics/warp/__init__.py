"""mujoco-warp behind the interface, and what all engines on Warp share."""

from legged.physics.warp import settings

__all__ = ["settings"]  # imported before anything here declares a kernel
