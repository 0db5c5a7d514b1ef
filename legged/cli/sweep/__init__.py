"""Sub-commands of `legged sweep`."""
