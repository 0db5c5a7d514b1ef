"""The fused step: kernels that each replace many of mujoco-warp's launches."""

from legged.physics.warp import settings

__all__ = ["settings"]  # `settings` must be imported before any module here declares a kernel
