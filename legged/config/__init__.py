"""Typed configuration. `schema` defines the settings, `loader` reads them."""

from legged.config.loader import from_dict, load_config, override, parse_override, to_dict, to_yaml
from legged.config.schema import LeggedConfig, TaskConfig

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
