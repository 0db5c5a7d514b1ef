"""Robots learn to walk and run: tasks on batched MuJoCo, trained by rsl-rl.

The names of this package are imported at their first use, because a robot's computer runs `legged.deploy` without torch and
MuJoCo.
"""

from legged.process.startup import importing, only_lists  # first, because it records the start time

import importlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or not only_lists():
    from legged.process.headless import HEADLESS  # before MuJoCo, because it sets MUJOCO_GL
    from legged.errors import ConfigError
    from legged.gymnasium_ids import announce

if TYPE_CHECKING:
    from legged.config import TaskConfig
    from legged.envs import LeggedRobot
    from legged.envs.marks import concurrent, unit
    from legged.registry import make_task, register, task_config

__all__ = [
    "HEADLESS",
    "ConfigError",
    "LeggedRobot",
    "TaskConfig",
    "concurrent",
    "make_task",
    "register",
    "task_config",
    "unit",
]
_HOMES = {
    "LeggedRobot": "legged.envs",
    "TaskConfig": "legged.config",
    "concurrent": "legged.envs",
    "make_task": "legged.registry",
    "register": "legged.registry",
    "task_config": "legged.registry",
    "unit": "legged.envs",
}
"""Name -> module that it is imported from at its first use."""


def __getattr__(name: str) -> Any:
    """Import and return a name of `__all__`, or a module of this package.

    Raises:
        AttributeError: there is no such name and no such module.
    """
    if name.startswith("_"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with importing():
        if name in _HOMES:
            globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
            return globals()[name]
        try:
            return importlib.import_module(f"{__name__}.{name}")
        except ModuleNotFoundError as error:
            if error.name != f"{__name__}.{name}":
                raise
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from error


def _task_names() -> Iterable[str]:
    """Return the names of all tasks."""
    with importing():
        registry = importlib.import_module("legged.registry")
    return registry.task_names()


if not only_lists():
    announce(_task_names)
