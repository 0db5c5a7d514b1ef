"""Tasks: Markov decision processes on batched physics."""

from legged.envs.base_task import BaseTask
from legged.envs.legged_robot import LeggedRobot, is_velocity_task
from legged.envs.marks import concurrent, unit
from legged.envs.robot_task import RobotTask, is_robot_task

__all__ = ["BaseTask", "LeggedRobot", "RobotTask", "concurrent", "is_robot_task", "is_velocity_task", "unit"]
