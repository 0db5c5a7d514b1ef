"""Loading of a TaskConfig from YAML files and `key=value` overrides. Errors name the file and the setting's dotted path."""

import copy
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from legged.config.checks import DEEPEST, SHOWN, build, hints_of, plain_path, shown
from legged.config.legged import LeggedConfig
from legged.config.origins import Origins
from legged.config.task import TaskConfig
from legged.config.yaml_files import dump, parse, read_yaml
from legged.errors import ConfigError, suggest
from legged.process.paths import data_folder, exists

LONGEST_CHAIN = 20
"""Largest number of files in a chain of `extends`."""
OF_FILES = ("extends", "own_rewards", "class", "written_for", "cpu")
"""Keys of a file that are not fields of the schema."""


@dataclass(frozen=True)
class Registered:
    """Configuration that user-defined code has registered: a file, or a mapping with the same keys."""

    config: Path | Mapping[str, Any]
    folder: Path
    """Folder of the user-defined code. Paths in a mapping are relative to this folder."""
    task_class: type | None = None
    """Class of the task; None if the configuration determines the class, by `class:` or by the task that it extends."""


Schema = TypeVar("Schema", bound=TaskConfig)
Source = Path | Mapping[str, Any] | Registered
Rescale = Callable[[Mapping[str, Any], str, str, str], Mapping[str, Any]]
"""Function: (settings, the robot for which they were written, the task's robot, prefix of error messages) -> settings for the
task's robot."""


def merge(base: dict[str, Any], top: Mapping[str, Any], source: str, origins: Origins, prefix: str = "") -> None:
    """Merge `top` into `base` in place. Maps are merged key by key. A list or a scalar replaces the value in `base`. Record
    `source` in `origins` as the source of each path. `top` has been checked, so that its nesting is limited.
    """
    for key, value in top.items():
        path = f"{prefix}{plain_path(key)}"
        if isinstance(value, Mapping):
            if not isinstance(base.get(key), dict):
                base[key] = {}
                origins.note(path, source)
            merge(base[key], value, source, origins, f"{path}.")
            continue
        base[key] = value
        origins.note(path, source)


@dataclass(frozen=True)
class Layer:
    """One configuration in a chain of `extends`."""

    data: Mapping[str, Any]
    """Settings, without `extends`, `own_rewards`, `class` and `written_for`."""
    name: str
    """Name of the configuration in error messages."""
    folder: Path
    """Folder to which the paths in the settings are relative."""
    task_class: Any
    """Class with which the task was registered, or else the value of the key `class`; None without both."""
    reference_robot: Any
    """Robot for which the numbers were written; None if they suit any robot."""
    own_rewards: bool
    """True if the reward scales of the extended configurations, and the schema's defaults, do not count."""


def read_layers(source: Source, task: str, registered: Mapping[str, Registered] | None = None) -> list[Layer]:
    """Return the configuration `source` of `task` and the chain of configurations that it extends, which are files or tasks
    in `registered`.

    Raises:
        ConfigError: a configuration is missing, can't be read, or extends itself.
    """
    layers: list[Layer] = []
    seen: list[Any] = []
    found = source if isinstance(source, Registered) else Registered(source, Path.cwd())
    while True:
        given = found.config
        is_file = isinstance(given, Path)
        name = str(given) if is_file else f"registered config of '{task}'"
        if _mark(found) in seen:
            chain = " -> ".join(Path(n).name for n in (*(layer.name for layer in layers), name))
            raise ConfigError(f"{name}: extends itself: {chain}")
        if len(layers) == LONGEST_CHAIN:
            raise ConfigError(f"{name}: extends: the chain of `extends` has more than {LONGEST_CHAIN} files")
        seen.append(_mark(found))
        data = dict(read_yaml(given) if isinstance(given, Path) else given)
        if data.get("task", own := Path(task).name.removesuffix(".yaml").removesuffix(".yml")) != own:
            said = f"{shown(data['task'])}; remove this key"
            raise ConfigError(
                f"{name}: task: the name of this task is '{own}', got {said}, or extend that task with `extends`"
            )
        parent, kind, reference_robot = (data.pop(key, None) for key in ("extends", "class", "written_for"))
        own_rewards = data.pop("own_rewards", False)
        if not isinstance(own_rewards, bool):
            raise ConfigError(f"{name}: own_rewards: expected true or false, got {shown(own_rewards)}")
        folder = given.parent if isinstance(given, Path) else found.folder
        layers.append(Layer(data, name, folder, found.task_class or kind, reference_robot, own_rewards))
        if parent is None:
            return layers
        others = {key: entry for key, entry in (registered or {}).items() if _mark(entry) not in seen}
        found, task = _parent(parent, name, folder if is_file else None, others), parent


def _mark(source: Registered) -> Any:
    """Return an identifier of a configuration."""
    return source.config.resolve() if isinstance(source.config, Path) else id(source.config)


def _parent(parent: Any, name: str, beside: Path | None, registered: Mapping[str, Registered]) -> Registered:
    """Find the configuration `parent`, which the configuration `name` extends. The search covers the files in the folder
    `beside`, then the registered tasks, then the tasks of this package.
    """
    if not isinstance(parent, str) or not parent:
        raise ConfigError(f"{name}: extends: expected the name of a task or a file in the same folder, got {shown(parent)}")
    file = parent if parent.endswith((".yaml", ".yml")) else f"{parent}.yaml"
    folders = [data_folder("cfg"), *([] if beside is None else [beside])]
    if beside is not None and exists(beside / file):
        return Registered(beside / file, beside)
    if parent in registered:
        return registered[parent]
    if exists(data_folder("cfg") / file):
        return Registered(data_folder("cfg") / file, data_folder("cfg"))
    names = {path.stem for folder in folders for path in folder.glob("*.yaml")} | set(registered)
    raise ConfigError(f"{name}: extends: there is no task or file {shown(parent)}{suggest(parent[:SHOWN], names)}")


def _merged(
    layers: Iterable[Layer], schema: type[TaskConfig], rescale: Rescale | None, robot: str | None, on_cpu: bool
) -> tuple[dict[str, Any], Origins]:
    """Merge layers. The values of a layer replace those of the layers that it extends. With `on_cpu`, the `cpu:` section of
    each layer is merged on top of the layer.

    Each layer is checked before the merge, because the values of another layer could hide its mistakes. Numbers of a layer
    with a reference robot are rescaled for `robot`. If `robot` is None, they are rescaled for the robot that the layers name.

    Raises:
        ConfigError: a layer does not fit the schema.
    """
    parts = []
    for layer in reversed(list(layers)):
        _check_layer(layer, schema)
        data = copy.deepcopy(dict(layer.data))
        for section in (data, data.get("cpu", {})):
            if "robot" in section:
                section["robot"] = robot_path(section["robot"], layer.folder)
            file_paths(section, layer.folder)
        parts.append((layer, data))
    if robot is None:
        asked = [data.get("cpu", {}).get("robot") for _, data in parts if on_cpu], [data.get("robot") for _, data in parts]
        robot = next((name for names in asked for name in reversed(names) if name), "")
    merged: dict[str, Any] = {}
    origins = Origins()
    for layer, data in parts:
        name = layer.name
        if layer.reference_robot is not None:
            where = f"{name}: written_for"
            if not isinstance(layer.reference_robot, str):
                raise ConfigError(f"{where}: expected the name of a robot, got {shown(layer.reference_robot)}")
            rescaled: Mapping[str, Any] = data
            if rescale is not None and isinstance(robot, str):  # a `robot` of a wrong type is refused later
                reference = robot_path(layer.reference_robot, layer.folder)
                rescaled = rescale(data, reference, robot, where)
                origins.reference_robots = tuple(dict.fromkeys([*origins.reference_robots, reference]))
            if rescaled is not data:
                data, name = dict(rescaled), f"{name} (written for {Path(layer.reference_robot).name})"
                origins.rescaled |= {name, f"{name}: cpu"}
        cpu = data.pop("cpu", {})
        if layer.own_rewards:
            merged.get("rewards", {}).pop("scales", None)
            defaults = hints_of(schema)["rewards"]().scales  # type: ignore[arg-type]
            merge(merged, {"rewards": {"scales": dict.fromkeys(defaults, 0.0)}}, layer.name, origins)
        merge(merged, data, name, origins)
        if on_cpu:
            merge(merged, cpu, f"{name}: cpu", origins)
    return merged, origins


def _check_layer(layer: Layer, schema: type[TaskConfig]) -> None:
    """Check that a layer and its `cpu:` section fit the schema. The section is checked on a GPU machine too.

    Raises:
        ConfigError: the layer or the section does not fit.
    """
    name, cpu = layer.name, layer.data.get("cpu", {})
    build(schema, {key: value for key, value in layer.data.items() if key != "cpu"}, name, others=OF_FILES)
    if not isinstance(cpu, Mapping):
        raise ConfigError(f"{name}: cpu: expected a mapping of sections, got {shown(cpu)}")
    if "task" in cpu:
        raise ConfigError(f"{name}: cpu: task: a task has the same name on every machine; remove this key")
    build(schema, cpu, f"{name}: cpu")


def robot_path(robot: Any, folder: Path) -> Any:
    """Return `robot`, a setting of a configuration file in `folder`, with a path made absolute.

    Names of robots under resources/robots/ are returned unchanged. Any other value is a path if it has a slash or a leading
    dot, or if it names a robot's folder in `folder` or in the working directory.
    """
    if not isinstance(robot, str) or not robot or exists(data_folder("resources") / "robots" / robot / "robot.yaml"):
        return robot
    for path in (folder / robot, Path.cwd() / robot):
        if exists(path / "robot.yaml"):
            return str(path.resolve())
    return str((folder / robot).absolute()) if robot.startswith(".") or "/" in robot else robot


def file_paths(section: Any, folder: Path) -> None:
    """Make the paths of a learned actuator and of reference motions in `section` absolute. A path is relative to `folder`,
    the folder of the configuration file. If no such file exists there, the path is relative to the working directory. Names
    of motions under resources/motions/ are kept, so that runs can be moved to another installation.
    """
    control, motion = (section.get(key) if isinstance(section, Mapping) else None for key in ("control", "motion"))
    actuator = control.get("actuator") if isinstance(control, Mapping) else None
    name = actuator.get("network") if isinstance(actuator, dict) else None
    if isinstance(actuator, dict) and isinstance(name, str) and name:
        actuator["network"] = str((folder / name if exists(folder / name) else Path.cwd() / name).absolute())
    files = motion.get("files") if isinstance(motion, dict) else None
    if isinstance(motion, dict) and isinstance(files, list | tuple) and all(name and isinstance(name, str) for name in files):
        packaged = data_folder("resources") / "motions"
        places = (folder, Path.cwd(), packaged)
        found = [next((place / name for place in places if exists(place / name)), folder / name).absolute() for name in files]
        motion["files"] = [str(path.relative_to(packaged) if path.is_relative_to(packaged) else path) for path in found]


def parse_override(text: str) -> tuple[str, Any]:
    """Return `a.b=1e-3` as ("a.b", 0.001). The value is read as YAML.

    Raises:
        ConfigError: the text does not have the form section.key=value.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise ConfigError(f"command line: '{plain_path(text)}' is not of the form section.key=value")
    return key.strip(), parse(value, f"command line: {plain_path(key)}: {shown(value)}")


def nest(path: str, value: Any) -> dict[str, Any]:
    """Return ("a.b", 1) as {"a": {"b": 1}}."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


def load_config(
    source: Source | list[Layer],
    task: str,
    overrides: Iterable[tuple[str, Any]] = (),
    on_cpu: bool = False,
    schema: type[TaskConfig] = LeggedConfig,
    rescale: Rescale | None = None,
) -> TaskConfig:
    """Load the configuration of a task as an instance of `schema`.

    `source` is a file, a mapping, or a list that `read_layers` has returned. It is merged onto the configurations that it
    extends. With `on_cpu`, the `cpu:` section of each configuration is merged too. `overrides` are merged last. `rescale`
    converts numbers that were written for another robot. It does not change overrides.

    Raises:
        ConfigError: an unknown key, a wrong type or a wrong value. The message names the file and the setting's dotted path.
    """
    layers = source if isinstance(source, list) else read_layers(source, task)
    overrides = list(overrides)
    named = [robot_path(value, Path.cwd()) for key, value in overrides if key == "robot"]
    data, origins = _merged(layers, schema, rescale, named[-1] if named else None, on_cpu)
    data["task"] = task
    _merge_overrides(data, overrides, origins, schema)
    return from_dict(data, origins, source=layers[0].name, schema=schema)


def _merge_overrides(
    data: dict[str, Any], overrides: Iterable[tuple[str, Any]], origins: Origins, schema: type[TaskConfig]
) -> None:
    """Merge overrides of the command line into `data`. Each override is checked before the merge, because a later override
    could hide its mistake.
    """
    for key, value in overrides:
        if key == "task":
            raise ConfigError("command line: task: can't be overridden; give the name of the task as the first argument")
        if key.count(".") > DEEPEST:
            raise ConfigError(f"command line: {shown(key)}: more than {DEEPEST} nested sections")
        layer = nest(key, robot_path(value, Path.cwd()) if key == "robot" else copy.deepcopy(value))
        build(schema, layer, "command line")
        file_paths(layer, Path.cwd())
        merge(data, layer, "command line", origins)


def from_dict(
    data: Mapping[str, Any],
    origins: Origins | None = None,
    source: str = "config",
    schema: type[TaskConfig] = LeggedConfig,
) -> TaskConfig:
    """Build an instance of `schema` from nested plain values. `origins` holds the sources of the values. Without
    `origins`, all values are from `source`.
    """
    cfg = build(schema, data, source, origins)
    if origins is None:
        origins = Origins()
        merge({}, data, source, origins)
    return dataclasses.replace(cfg, origins=origins)


def override(cfg: Schema, overrides: Iterable[tuple[str, Any]]) -> Schema:
    """Return a copy of `cfg` with some settings replaced and checked. `overrides` are pairs of a dotted path and a value."""
    data = to_dict(cfg)
    origins = copy.copy(cfg.origins)
    _merge_overrides(data, overrides, origins, type(cfg))
    return from_dict(data, origins, source=cfg.task, schema=type(cfg))  # type: ignore[return-value]


def to_dict(config: Any) -> Any:
    """Return a configuration as nested plain values, which YAML can write."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_dict(getattr(config, f.name)) for f in dataclasses.fields(config) if f.compare}
    if isinstance(config, Mapping):
        return {k: to_dict(v) for k, v in config.items()}
    if isinstance(config, list | tuple):
        return [to_dict(v) for v in config]
    return config


def to_yaml(config: TaskConfig) -> str:
    """Return the complete configuration as YAML, which `load_config` can read."""
    return dump(to_dict(config), sort_keys=False, default_flow_style=None, width=120)
