"""Typed configuration. `schema` defines the settings, `loader` reads them.

Code that treats some tasks differently asks for one of these capabilities, and not for a class:

| capability | of a configuration | of a built task (`legged.envs`) |
|---|---|---|
| a robot: joints with a control law, feet, and a ground that `terrain` sets | `has_robot` | `is_robot_task` |
| robots can be steered by velocity commands | `follows_velocities` | `is_velocity_task` |
| robots track reference motions | `tracking.tracks_motions` | `MotionTracking` |
| the ground has tiles, on which robots can be placed | `terrain.mesh_type` | `terrain_curriculum` |
| switches that a measurement sets to false | `DISTURBANCES` | |
"""

from legged.config.legged import follows_velocities
from legged.config.loader import from_dict, load_config, override, parse_override, to_dict, to_yaml
from legged.config.robot import has_robot
from legged.config.schema import LeggedConfig, RobotConfig, TaskConfig

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
