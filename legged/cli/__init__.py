"""The `legged` command. Each module has one sub-command, or a group of sub-commands such as `legged benchmark`."""
