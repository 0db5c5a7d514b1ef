"""Tasks as environments of Gymnasium: `gymnasium.make("legged/<task>")` and `gymnasium.make_vec` (docs/gymnasium.md)."""

from legged.gymnasium_envs.single import TaskEnv
from legged.gymnasium_envs.vector import TaskVectorEnv

__all__ = ["TaskEnv", "TaskVectorEnv"]
