"""Migration of configurations of legged_gym and its forks to tasks of this package. A child process runs their files."""
