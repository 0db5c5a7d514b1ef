"""Sub-commands of `legged robot`."""
