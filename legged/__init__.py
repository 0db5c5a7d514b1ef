"""Robots learn to walk and run: tasks on batched MuJoCo, trained by rsl-rl.

What this package offers is imported when it is first asked for: a robot's computer runs `legged.deploy` out of this package,
and has neither torch nor MuJoCo.
"""

from legged.process.startup import importing, only_lists  # first: it looks at the time

import importlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or not only_lists():
    from legged.process.headless import HEADLESS  # before MuJoCo: it sets MUJOCO_GL
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
"""Name -> the module that it is imported from when somebody asks for it."""


def __getattr__(name: str) -> Any:
    """Import what is asked for: a name of `__all__`, or a module of this package."""
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
    """Return the names of the tasks there are."""
    with importing():
        registry = importlib.import_module("legged.registry")
    return registry.task_names()


if not only_lists():
    announce(_task_names)
