"""The `legged` command: one module for each sub-command."""
