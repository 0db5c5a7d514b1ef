"""Typed configuration: dataclasses define every setting of a task file, with meaning, unit, default and bounds.

A file under `cfg/` states only the differences from the defaults. The sections of every task are in task.py, world.py, mdp.py
and learning.py. Those of a legged robot with velocity commands are in legged.py. `loader` reads and checks files.
"""

from legged.config.legged import LeggedConfig
from legged.config.loader import from_dict, load_config, override, parse_override, to_dict, to_yaml
from legged.config.task import TaskConfig

__all__ = [
    "LeggedConfig",
    "TaskConfig",
    "from_dict",
    "load_config",
    "override",
    "parse_override",
    "to_dict",
    "to_yaml",
]
