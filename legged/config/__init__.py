"""Typed configuration. `schema` defines the settings, `loader` reads them, `capabilities` tells kinds of tasks apart."""

from legged.config.capabilities import follows_velocities, has_robot
from legged.config.loader import from_dict, load_config, override, parse_override, to_dict, to_yaml
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
