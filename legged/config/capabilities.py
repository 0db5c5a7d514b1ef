"""Capabilities of tasks.

Code that treats some tasks differently asks one of these questions, and does not ask for a class.

| question | about a configuration | about a built task |
|---|---|---|
| Is there a robot: joints with a control law, feet, and a ground that `terrain` sets? | `has_robot` | `is_robot_task` |
| Can robots be steered by velocity commands? | `follows_velocities` | `is_velocity_task` |
| Is the ground made of tiles, on which robots can be placed? | `terrain.mesh_type` | `terrain_curriculum` |
| Which switches does a measurement set to false? | `DISTURBANCES` | |

`legged.envs` has the functions about built tasks.
"""

from typing import TypeGuard

from legged.config.legged import LeggedConfig
from legged.config.robot import RobotConfig
from legged.config.task import TaskConfig


def has_robot(cfg: TaskConfig) -> TypeGuard[RobotConfig]:
    """Return whether the task has a robot, on a ground that the section `terrain` sets."""
    return isinstance(cfg, RobotConfig)


def follows_velocities(cfg: TaskConfig) -> TypeGuard[LeggedConfig]:
    """Return whether the robots follow velocity commands, so that a grid of commands can measure them."""
    return isinstance(cfg, LeggedConfig)
