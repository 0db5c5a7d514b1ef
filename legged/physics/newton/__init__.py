"""Newton's solvers behind the `Physics` interface."""

from legged.physics.warp import settings

__all__ = ["settings"]  # `settings` must be imported before any module here declares a kernel
