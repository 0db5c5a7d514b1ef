"""Errors of the package: those that end a command with one line, and those of a task's terms and steps."""

from legged.deploy.errors import LONGEST, ConfigError, RunError, one_line, suggest  # noqa: F401  (names for other modules)


class TermError(RuntimeError):
    """Failure of a term's method, such as `_reward_*` or `_obs_*`. The text names the method."""


class HostReadError(RuntimeError):
    """A step reads a tensor's value on the host, or uses host data that a CUDA graph can't hold."""
