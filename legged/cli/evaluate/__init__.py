"""Sub-commands of `legged evaluate`."""
