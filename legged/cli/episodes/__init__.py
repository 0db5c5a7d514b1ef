"""Sub-commands of `legged episodes`."""
