"""Sub-commands of `legged runs`."""
