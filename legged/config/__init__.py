"""Typed configuration: `schema` says what can be set, `loader` reads it."""

from legged.config.loader import ConfigError, from_dict, load_config, override, parse_override, suggest, to_dict, to_yaml
from legged.config.schema import TaskConfig

__all__ = [
    "ConfigError",
    "TaskConfig",
    "from_dict",
    "load_config",
    "override",
    "parse_override",
    "suggest",
    "to_dict",
    "to_yaml",
]
