"""Registry of tasks: names, task classes and configurations. Every `cfg/*.yaml` is a task; users register their own."""

import sys
from collections.abc import Iterable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from legged.config import TaskConfig, load_config
from legged.config.checks import PLAIN, is_plain_name, shown
from legged.config.loader import Layer, Registered, Rescale, read_layers
from legged.config.rescale import rescale
from legged.envs import BaseTask, LeggedRobot, RobotTask
from legged.envs.marks import unit_of
from legged.errors import ConfigError, suggest
from legged.gymnasium_ids import add_ids
from legged.physics.fields import FIELDS
from legged.process.paths import data_folder, exists
from legged.process.startup import importing, stage_ended
from legged.robots.similarity import grown, size_of
from legged.terrain import TERRAIN_TYPES, Terrain
from legged.user_modules import run_module

__all__ = [
    "import_tasks",
    "make_task",
    "register",
    "register_file",
    "task_class",
    "task_config",
    "task_names",
    "task_schema",
]

YAML_ENDINGS = (".yaml", ".yml")
CLASSES = {
    "LeggedRobot": "legged.envs.legged_robot",
    "MotionTracking": "legged.envs.motion_tracking",
    "HalfCheetah": "legged.envs.half_cheetah",
    "Humanoid": "legged.envs.humanoid",
}
"""Name of a task class of this package, for `class:` in a task's YAML -> module of the class."""


_REGISTERED: dict[str, Registered] = {}


def register(name: str, config: Path | str | Mapping[str, Any], task_class: type[BaseTask] | None = None) -> None:
    """Register the task `name`. `config` is a YAML file, or a mapping with the same keys. `task_class` is a subclass of
    LeggedRobot or BaseTask; by default it is the class that the configuration names (`class:`), else the class of the task
    that it extends, else LeggedRobot.

    In a configuration, `extends: anymal_c_flat` builds on a task of this package or on a registered one. A relative
    path of a YAML file is looked for in the folder of the calling module, then in the working directory. Relative paths in a
    mapping start at the folder of the calling module, or at the working directory if that module is not a file.

    Raises:
        ConfigError: the name is invalid, or the class or the configuration has a wrong type.
    """
    if not isinstance(name, str) or not is_plain_name(name):
        raise ConfigError(f"register: the name of a task must be {PLAIN}; got {shown(name)}")
    if task_class is not None and not (isinstance(task_class, type) and issubclass(task_class, BaseTask)):
        raise ConfigError(f"register('{name}'): expected a subclass of LeggedRobot or BaseTask, got {shown(task_class)}")
    if not isinstance(config, str | Path | Mapping):
        raise ConfigError(f"register('{name}'): expected a YAML file or a mapping of sections, got {shown(config)}")
    file = sys._getframe(1).f_globals.get("__file__")
    folder = Path(file).resolve().parent if isinstance(file, str) else Path.cwd()
    if isinstance(config, str | Path):
        beside = folder / config
        config = (beside if exists(beside) else Path(config)).absolute()
    _REGISTERED[name] = Registered(config, folder, task_class)
    add_ids([name])


def import_tasks(name: str) -> None:
    """Register user-defined tasks. `name` is the name or path of a module to run, or the path of a YAML file. Commas
    separate several names, such as the module of a class and a YAML file that uses the class.

    Raises:
        ConfigError: a module or a file can't be found, or fails.
    """
    for one in name.split(","):
        if one.endswith(YAML_ENDINGS):
            register_file(one, "--import")
        else:
            run_module(one)


def register_file(path: str, flag: str = "TASK") -> str:
    """Register the YAML file at `path` as a task, and return its name: the file's name without ending. `flag` is the option
    or argument that named the file, for errors.

    Raises:
        ConfigError: there is no such file, its name is invalid, or another task has that name.
    """
    file = Path(path).absolute()
    if not exists(file) or file.is_dir():
        raise ConfigError(f"{flag}: there is no file {shown(path)}")
    name = file.stem
    if not is_plain_name(name):
        raise ConfigError(f"{flag}: {shown(path)}: the name of the file, without ending, must be {PLAIN}")
    known = _REGISTERED.get(name)
    ours = data_folder("cfg") / f"{name}.yaml"
    other = known.config if known is not None else ours if ours.is_file() else None
    if other is None:
        _REGISTERED[name] = Registered(file, file.parent)
        add_ids([name])
    elif not isinstance(other, Path) or other.resolve() != file.resolve():
        where = other if isinstance(other, Path) else "registered from code"
        raise ConfigError(f"{flag}: '{path}': there is another task '{name}' ({where}); give the file another name")
    return name


def task_names() -> list[str]:
    """Return the names of all tasks, sorted."""
    return sorted({path.stem for path in data_folder("cfg").glob("*.yaml")} | set(_REGISTERED))


def _layers_of(name: str) -> list[Layer]:
    """Return the configuration of a task and those that it extends.

    Raises:
        ConfigError: the task does not exist, or a configuration can't be read.
    """
    entry = _REGISTERED.get(name)
    if entry is None:
        path = data_folder("cfg") / f"{name}.yaml"
        if not is_plain_name(name) or not path.is_file():
            raise ConfigError(f"TASK: there is no task {shown(name)}{suggest(name[:100], task_names(), 'tasks')}")
        entry = Registered(path, path.parent)
    return read_layers(entry, name, _REGISTERED)


def task_class(name: str) -> type[BaseTask]:
    """Return the class of a task.

    Raises:
        ConfigError: the task does not exist, or its configuration names a class that does not exist.
    """
    return _class_of(_layers_of(name))


def _class_of(layers: Iterable[Layer]) -> type[BaseTask]:
    """Return the class that the first of `layers` with a class names, or else LeggedRobot."""
    layer = next((layer for layer in layers if layer.task_class is not None), None)
    if layer is None:
        return LeggedRobot
    kind = layer.task_class
    is_class = isinstance(kind, type) and issubclass(kind, BaseTask)
    return kind if is_class else _class_named(kind, f"{layer.name}: class")


def _class_named(kind: Any, where: str) -> type[BaseTask]:
    """Return the task class named `kind`: a class of this package, or of a registered task."""
    registered = {entry.task_class.__name__: entry.task_class for entry in _REGISTERED.values() if entry.task_class}
    if isinstance(kind, str) and kind in registered and kind not in CLASSES:  # the names of our classes cannot be redefined
        return registered[kind]
    if not isinstance(kind, str) or kind not in CLASSES:
        raise ConfigError(f"{where}: there is no task class {shown(kind)}{suggest(str(kind)[:100], {*CLASSES, *registered})}")
    return getattr(import_module(CLASSES[kind]), kind)  # type: ignore[no-any-return]


def _schema_of(kind: type[BaseTask]) -> type[TaskConfig]:
    """Return the configuration schema of a task class.

    Raises:
        ConfigError: `Config` is not a frozen dataclass that extends the schema of the class's nearest parent in this package.
    """
    ours: Any = next(part for part in kind.__mro__ if part.__module__.startswith("legged."))
    base, schema = ours.Config, kind.Config
    # Without @dataclass, the fields that a class adds would be ignored silently.
    decorated = isinstance(schema, type) and "__dataclass_fields__" in vars(schema)
    if not decorated or not issubclass(schema, base):
        raise ConfigError(
            f"{kind.__module__}.{kind.__name__}.Config: expected {base.__name__}, or a class with @dataclass(frozen=True)"
            f" that extends it; got {shown(schema)}"
        )
    return schema


def task_schema(name: str) -> type[TaskConfig]:
    """Return the schema of a task's configuration. For a task that no longer exists, return the schema of LeggedRobot."""
    try:
        return _schema_of(task_class(name))
    except ConfigError:
        return LeggedRobot.Config


def task_config(name: str, overrides: Iterable[tuple[str, Any]] = (), on_cpu: bool = False) -> TaskConfig:
    """Return the configuration of a task, checked completely, without building anything. `overrides` are pairs of a dotted
    path and a value; `on_cpu` applies the section `cpu` of the configuration.

    Raises:
        ConfigError: there is no such task, or its configuration is invalid.
    """
    layers = _layers_of(name)
    kind = _class_of(layers)
    schema = _schema_of(kind)
    cfg = load_config(layers, name, overrides, on_cpu, schema, _rescaler(kind, schema))
    kind.check(cfg)
    return cfg


def _rescaler(kind: type[BaseTask], schema: type[TaskConfig]) -> Rescale:
    """Return the function that rescales a configuration from its reference robot to another robot."""

    def unit_at(name: str) -> str:
        section, _, entry = name.rpartition(".")
        if section == "terrain.sizes":
            return TERRAIN_TYPES[entry].unit if entry in TERRAIN_TYPES else "1"
        if section == "domain_rand.ranges":
            return FIELDS[entry].unit.partition(" or ")[0] if entry in FIELDS else "1"
        return unit_of(getattr(kind, name, None)) or "1"  # `check_terms` refuses terms without a unit

    def rescale_layer(data: Mapping[str, Any], reference_robot: str, robot: str, where: str) -> Mapping[str, Any]:
        if not issubclass(kind, RobotTask):
            raise ConfigError(f"{where}: a task of {kind.__name__} has no robot to which numbers could be rescaled")
        reference = size_of(reference_robot, where)
        if not robot or robot == reference_robot:
            return data
        try:
            size = size_of(robot)
        except ConfigError:
            return data  # `check` reports the error and the place that names the robot
        factor = partial(grown, reference=reference, robot=size)
        rescaled = rescale({key: value for key, value in data.items() if key != "cpu"}, schema, factor, unit_at)
        return rescaled | ({"cpu": rescale(data["cpu"], schema, factor, unit_at)} if "cpu" in data else {})

    return rescale_layer


def make_task(cfg: TaskConfig, device: torch.device | str = "cpu", graph: bool = True, terrain: Terrain | None = None) -> Any:
    """Build and return the task of a configuration. The task is on the given terrain, or on its own if `terrain` is None.

    Raises:
        ConfigError: the configuration does not fit the engine, or the class does not call super().__init__.
        TermError: a term fails or cannot be captured.
    """
    other_ground = {} if terrain is None else {"terrain": terrain}  # a user's constructor may lack `terrain`
    kind: Any = task_class(cfg.task)
    with importing():
        task = kind(cfg, device, graph, **other_ground)
    stage_ended("step captured")
    if not hasattr(task, "observation_groups"):
        raise ConfigError(f"{kind.__module__}.{kind.__name__}: its constructor must call super().__init__ with its arguments")
    return task
