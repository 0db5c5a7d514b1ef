"""Tasks: the MDPs."""

from legged.envs.base_task import BaseTask
from legged.envs.legged_robot import LeggedRobot

__all__ = ["BaseTask", "LeggedRobot"]
