"""Tasks: Markov decision processes on batched physics."""

from legged.envs.base_task import BaseTask
from legged.envs.legged_robot import LeggedRobot
from legged.envs.marks import concurrent, unit
from legged.envs.robot_task import RobotTask

__all__ = ["BaseTask", "LeggedRobot", "RobotTask", "concurrent", "unit"]
