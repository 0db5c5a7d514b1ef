"""Launches of our own that take the place of many of mujoco-warp's."""

from legged.physics.warp import settings

__all__ = ["settings"]  # imported before anything here declares a kernel
