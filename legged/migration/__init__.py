"""Migration of configuration classes of legged_gym and its forks to tasks. Their files are parsed, never run."""
