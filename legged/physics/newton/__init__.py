"""Newton's solvers behind the `Physics` interface."""

from legged.physics.warp import settings

__all__ = ["settings"]  # before any module here declares a kernel
