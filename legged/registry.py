"""Task names -> task class and configuration. Every `cfg/*.yaml` is a task; outside code adds its own."""

import importlib
import importlib.util
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from legged.config import TaskConfig, load_config
from legged.envs import LeggedRobot
from legged.errors import ConfigError, suggest
from legged.paths import data_folder
from legged.terrain import Terrain


@dataclass(frozen=True)
class _Entry:
    task_class: type[LeggedRobot]
    config: Path | Mapping[str, Any]


_REGISTERED: dict[str, _Entry] = {}


def register(name: str, config: Path | str | Mapping[str, Any], task_class: type[LeggedRobot] = LeggedRobot) -> None:
    """Make `name` a task: a YAML file, or a mapping with the same keys, and a subclass of LeggedRobot.

    `extends: anymal_c_flat` in it builds on a task of this package.
    """
    _REGISTERED[name] = _Entry(task_class, Path(config).resolve() if isinstance(config, str | Path) else config)


def task_names() -> list[str]:
    """All tasks there are."""
    return sorted({path.stem for path in data_folder("cfg").glob("*.yaml")} | set(_REGISTERED))


def _entry(name: str) -> _Entry:
    if name in _REGISTERED:
        return _REGISTERED[name]
    path = data_folder("cfg") / f"{name}.yaml"
    if not path.is_file():
        raise ConfigError(f"--task: there is no task '{name}'{suggest(name, task_names(), 'tasks')}")
    return _Entry(LeggedRobot, path)


def task_class(name: str) -> type[LeggedRobot]:
    """The class of a task.

    Raises:
        ConfigError: no such task.
    """
    return _entry(name).task_class


def task_config(name: str, overrides: Iterable[tuple[str, Any]] = (), on_cpu: bool = False) -> TaskConfig:
    """The configuration of a task, checked down to its reward names and gains, but with nothing built.

    Raises:
        ConfigError: no such task, or a mistake in its configuration.
    """
    entry = _entry(name)
    cfg = load_config(entry.config, name, overrides, on_cpu)
    entry.task_class.check(cfg)
    return cfg


def make_task(
    cfg: TaskConfig, device: torch.device | str = "cpu", graph: bool = True, terrain: Terrain | None = None
) -> LeggedRobot:
    """Build the task that a configuration describes, on its own terrain or on the one given."""
    other_ground = {} if terrain is None else {"terrain": terrain}  # a user's constructor may not know the argument
    return task_class(cfg.task)(cfg, device, graph, **other_ground)


def import_tasks(name: str) -> None:
    """Run a user's module, 'my_tasks' or 'path/my_tasks.py', so that it registers its tasks.

    Raises:
        ConfigError: it can't be found.
    """
    path = Path(name)
    if path.suffix == ".py":
        spec = importlib.util.spec_from_file_location(path.stem, path)
        if spec is None or spec.loader is None or not path.is_file():
            raise ConfigError(f"--import: there is no file '{name}'")
        module = importlib.util.module_from_spec(spec)
        sys.modules[path.stem] = module
        spec.loader.exec_module(module)
        return
    sys.path.insert(0, str(Path.cwd()))
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ConfigError(f"--import: there is no module '{name}' (a module name, or a path that ends in .py)") from error
