"""Newton's solvers behind the `Physics` interface."""

from legged.physics.warp import settings

__all__ = ["settings"]  # must be imported before a module here declares a kernel
