"""The fused step: kernels that each replace many of mujoco-warp's launches."""

from legged.physics.warp import settings

__all__ = ["settings"]  # imported before a module here declares a kernel
