"""Collider for height maps."""

from legged.physics.warp import settings

__all__ = ["settings"]  # before any module here declares a kernel
