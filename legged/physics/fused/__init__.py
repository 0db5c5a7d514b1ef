"""Launches of our own that take the place of many of mujoco-warp's."""
