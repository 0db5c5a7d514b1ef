"""Collider for height maps."""

from legged.physics.warp import settings

__all__ = ["settings"]  # `settings` must be imported before any module here declares a kernel
