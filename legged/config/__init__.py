"""Typed configuration: dataclasses define every setting of a task file, with meaning, unit, default and bounds.

A file under `cfg/` states only the differences from the defaults. The sections of every task are in task.py, world.py, mdp.py
and learning.py. Those of a task with a robot are in robot.py, and those of velocity commands in legged.py. `loader` reads and
checks files.

Code that treats some tasks differently asks for one of these capabilities, and not for a class:

| capability | of a configuration | of a built task (`legged.envs`) |
|---|---|---|
| a robot: joints with a control law, feet, and a ground that `terrain` sets | `has_robot` | `is_robot_task` |
| robots can be steered by velocity commands | `follows_velocities` | `is_velocity_task` |
| robots track reference motions | `tracking.tracks_motions` | `MotionTracking` |
| the ground has tiles, on which robots can be placed | `terrain.mesh_type` | `terrain_curriculum` |
| switches that a measurement sets to false | `DISTURBANCES` | |
"""

from legged.config.legged import LeggedConfig, follows_velocities
from legged.config.loader import from_dict, load_config, override, parse_override, to_dict, to_yaml
from legged.config.robot import RobotConfig, has_robot
from legged.config.task import TaskConfig

__all__ = [
    "LeggedConfig",
    "RobotConfig",
    "TaskConfig",
    "follows_velocities",
    "from_dict",
    "has_robot",
    "load_config",
    "override",
    "parse_override",
    "to_dict",
    "to_yaml",
]
