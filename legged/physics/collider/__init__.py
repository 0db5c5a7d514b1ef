"""Collider for height maps."""

from legged.physics import warp_settings

__all__ = ["warp_settings"]  # `warp_settings` must be imported before any module here declares a kernel
