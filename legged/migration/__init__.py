"""Migration of configurations of legged_gym and its forks to tasks. A child process runs the configurations' files."""
