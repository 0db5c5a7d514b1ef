"""Configuration classes of legged_gym and its forks -> tasks here. Their files are read, never run."""
