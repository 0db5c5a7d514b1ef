"""Robots learn to walk and run: tasks on batched MuJoCo, trained by rsl-rl."""

from legged.process.startup import importing, only_lists  # first: it looks at the time

if not only_lists():
    with importing():
        from legged.process.headless import HEADLESS  # before MuJoCo: it sets MUJOCO_GL
        from legged.config import TaskConfig
        from legged.errors import ConfigError
        from legged.envs import LeggedRobot
        from legged.registry import make_task, register, task_config, task_names
        from legged.gymnasium_ids import announce

    announce(task_names)

__all__ = ["HEADLESS", "ConfigError", "LeggedRobot", "TaskConfig", "make_task", "register", "task_config"]
