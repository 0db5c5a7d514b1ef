"""A framework in which robots learn to walk and run. MuJoCo simulates many robots at once, and rsl-rl trains their policies.

Most names in `__all__` are imported only at their first use. So `legged.deploy` also runs on a robot's computer that has
neither torch nor MuJoCo.
"""

from legged.process.startup import importing, only_lists  # comes first, because this module records the start time

import importlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or not only_lists():
    from legged.process.headless import HEADLESS  # must precede MuJoCo, because this module sets MUJOCO_GL
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
"""Name -> module from which the name is imported at its first use."""


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
