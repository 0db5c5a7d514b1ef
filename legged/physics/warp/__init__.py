"""mujoco-warp behind the interface, and what all engines on Warp share."""
