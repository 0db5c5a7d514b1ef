"""Sub-commands of `legged deploy`."""
