"""Newton's solvers behind the interface."""

from legged.physics.warp import settings

__all__ = ["settings"]  # imported before anything here declares a kernel
