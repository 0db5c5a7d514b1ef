"""Legged robots learn to walk: legged_gym's task on batched MuJoCo, trained by rsl-rl."""

import legged.clock  # noqa: F401, I001  first: it looks at the time
from legged.headless import HEADLESS  # before MuJoCo: it sets MUJOCO_GL
from legged.config import ConfigError, TaskConfig
from legged.envs import LeggedRobot
from legged.registry import make_task, register, task_config

__all__ = ["HEADLESS", "ConfigError", "LeggedRobot", "TaskConfig", "make_task", "register", "task_config"]
