"""Sub-commands of `legged benchmark`."""
