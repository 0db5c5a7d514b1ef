"""YAML files and `key=value` overrides -> TaskConfig; every mistake is an error that names file and dotted path."""

import copy
import dataclasses
import re
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import yaml

from legged.config.origins import Origins
from legged.config.schema import TaskConfig
from legged.errors import ConfigError, suggest
from legged.paths import data_folder

T = TypeVar("T")


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads `1e-4` as a number (YAML 1.1 wants a dot) and refuses a key given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                line = node.start_mark.line + 1
                raise ConfigError(f"{self.name}: key '{key}' is given twice in the block from line {line}")
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; ConfigError when it is missing, malformed or no mapping."""
    try:
        with path.open(encoding="utf-8") as stream:
            loader = _Loader(stream)
            loader.name = str(path)
            try:
                data = loader.get_single_data()
            finally:
                loader.dispose()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping of sections, got {type(data).__name__}")
    return data


def merge(base: dict[str, Any], top: Mapping[str, Any], source: str, origins: Origins, prefix: str = "") -> None:
    """Lays `top` over `base` in place: maps merge, lists and scalars replace. Notes in `origins` who set each path."""
    for key, value in top.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping):
            if not isinstance(base.get(key), dict):
                base[key] = {}
                origins.note(path, source)
            merge(base[key], value, source, origins, f"{path}.")
            continue
        base[key] = value
        origins.note(path, source)


def _read_chain(source: Path | Mapping[str, Any], name: str, seen: tuple[Path, ...] = ()) -> tuple[dict[str, Any], Origins]:
    """A file (or a mapping in a user's code), called `name` in errors, laid over the files it extends."""
    if isinstance(source, Path):
        if source in seen:
            raise ConfigError(f"{source}: extends itself: {' -> '.join(p.name for p in (*seen, source))}")
        data, folders, seen = read_yaml(source), [source.parent, data_folder("cfg")], (*seen, source)
    else:
        data, folders = copy.deepcopy(dict(source)), [data_folder("cfg")]
    parent = data.pop("extends", None)
    merged: dict[str, Any] = {}
    origins = Origins()
    if parent is not None:
        found = [folder / f"{parent}.yaml" for folder in folders if (folder / f"{parent}.yaml").is_file()]
        if not found:
            names = {p.stem for folder in folders for p in folder.glob("*.yaml")}
            raise ConfigError(f"{name}: extends: there is no '{parent}'{suggest(str(parent), names)}")
        merged, origins = _read_chain(found[0], str(found[0]), seen)
    merge(merged, data, name, origins)
    return merged, origins


def parse_override(text: str) -> tuple[str, Any]:
    """`a.b=1e-3` -> ("a.b", 0.001); the value is read as YAML."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise ConfigError(f"command line: '{text}' is not of the form section.key=value")
    try:
        loader = _Loader(value)
        try:
            return key.strip(), loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise ConfigError(f"command line: {key}: '{value}' is not a YAML value: {error}") from error


def nest(path: str, value: Any) -> dict[str, Any]:
    """("a.b", 1) -> {"a": {"b": 1}}."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


def load_config(
    source: Path | Mapping[str, Any], task: str, overrides: Iterable[tuple[str, Any]] = (), on_cpu: bool = False
) -> TaskConfig:
    """The task file or mapping `source`, over the files it extends, under its `cpu:` section (if asked) and overrides.

    Raises:
        ConfigError: unknown key, wrong type or value, with file and dotted path.
    """
    name = str(source) if isinstance(source, Path) else f"registered config of '{task}'"
    data, origins = _read_chain(source, name)
    cpu = data.pop("cpu", {})
    if not isinstance(cpu, dict):
        raise ConfigError(f"{origins.where('cpu')}: expected a mapping of sections, got {cpu!r}")
    data["task"] = task

    def with_cpu(apply: bool) -> tuple[dict[str, Any], Origins]:
        merged = copy.deepcopy(data)
        where = Origins(origins)
        if apply:
            set_here = Origins()
            merge(merged, cpu, "", set_here)
            for path in set_here:
                where.note(path, origins.of(f"cpu.{path}") + ": cpu")
        return merged, where

    from_dict(*with_cpu(True), source=name)  # so that a mistake in `cpu:` is found on a GPU machine too
    merged, where = with_cpu(on_cpu)
    for key, value in overrides:
        _refuse_task(key)
        merge(merged, nest(key, value), "command line", where)
    return from_dict(merged, where, source=name)


def _refuse_task(key: str) -> None:
    if key == "task":
        raise ConfigError("command line: task: can't be overridden; choose the task with --task")


def from_dict(data: Mapping[str, Any], origins: Origins | None = None, source: str = "config") -> TaskConfig:
    """TaskConfig from nested plain values; `origins` says who set them, if not all are from `source`."""
    if origins is None:
        origins = Origins()
        merge({}, data, source, origins)
    cfg = build(TaskConfig, data, "", origins, source)
    cfg.origins.update(origins)
    return cfg


def override(cfg: TaskConfig, overrides: Iterable[tuple[str, Any]]) -> TaskConfig:
    """`cfg` with some dotted paths replaced, by the command line or by what it asks for, checked again."""
    data = to_dict(cfg)
    origins = Origins(cfg.origins)
    for key, value in overrides:
        _refuse_task(key)
        merge(data, nest(key, value), "command line", origins)
    return from_dict(data, origins, source=cfg.task)


def build(schema: type[T], data: Any, path: str, origins: Origins, source: str) -> T:
    """An instance of the dataclass `schema` from a mapping, checked field by field."""
    where = f"{_origin(path, origins, source)}: {path or 'top level'}"
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: expected a mapping with keys of {schema.__name__}, got {data!r}")
    fields = {f.name: f for f in dataclasses.fields(schema) if f.compare}  # type: ignore[arg-type]
    hints = typing.get_type_hints(schema)
    values: dict[str, Any] = {}
    for key, value in data.items():
        dotted = f"{path}.{key}" if path else str(key)
        if key not in fields:
            raise ConfigError(f"{_origin(dotted, origins, source)}: {dotted}: unknown key '{key}'{suggest(str(key), fields)}")
        if dataclasses.is_dataclass(hints[key]):
            values[key] = build(hints[key], value, dotted, origins, source)  # type: ignore[arg-type]
            continue
        checked = _check(hints[key], value, dotted, origins, source)
        if fields[key].metadata:
            _check_bounds(checked, fields[key].metadata, f"{_origin(dotted, origins, source)}: {dotted}")
        if typing.get_origin(hints[key]) is dict:  # maps merge with the schema's default entries
            factory = fields[key].default_factory
            checked = {**(factory() if callable(factory) else {}), **checked}
        values[key] = checked
    return schema(**values)


def _origin(path: str, origins: Origins, source: str) -> str:
    """Who gave the value at `path`; `source` where nobody in particular did."""
    return origins.of(path) if path and origins else source


def _check(kind: Any, value: Any, path: str, origins: Origins, source: str) -> Any:
    """`value` as `kind`, or ConfigError. Integers count as floats, lists as tuples; nothing else is converted."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)

    def fail(expected: str) -> ConfigError:
        return ConfigError(f"{_origin(path, origins, source)}: {path}: expected {expected}, got {value!r}")

    if kind is Any:
        return value
    if origin is Literal:
        if value not in args:
            raise ConfigError(
                f"{_origin(path, origins, source)}: {path}: unknown value {value!r}{suggest(str(value), map(str, args))}"
            )
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        return _check(next(a for a in args if a is not type(None)), value, path, origins, source)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise fail("a list")
        if len(args) == 2 and args[1] is Ellipsis:
            return tuple(_check(args[0], v, f"{path}[{i}]", origins, source) for i, v in enumerate(value))
        if len(value) != len(args):
            raise fail(f"a list of {len(args)} numbers")
        checked = tuple(_check(args[i], v, f"{path}[{i}]", origins, source) for i, v in enumerate(value))
        if args == (float, float) and checked[0] > checked[1]:
            raise fail("[low, high] with low <= high")
        return checked
    if origin is dict:
        if not isinstance(value, Mapping):
            raise fail("a mapping")
        return {str(k): _check(args[1], v, f"{path}.{k}", origins, source) for k, v in value.items()}
    if kind is bool:
        if not isinstance(value, bool):
            raise fail("true or false")
    elif kind is int:
        if not isinstance(value, int) or isinstance(value, bool):
            raise fail("a whole number")
    elif kind is float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise fail("a number")
        value = float(value)
        if value != value:
            raise fail("a number")
    elif kind is str and not isinstance(value, str):
        raise fail("text")
    return value


def _check_bounds(value: Any, bounds: Mapping[str, float], where: str) -> None:
    if isinstance(value, tuple):
        if not value:
            raise ConfigError(f"{where}: must not be empty")
        for i, item in enumerate(value):
            _check_bounds(item, bounds, f"{where}[{i}]")
        return
    if "min" in bounds and value < bounds["min"]:
        raise ConfigError(f"{where}: must be at least {bounds['min']}, got {value}")
    if "max" in bounds and value > bounds["max"]:
        raise ConfigError(f"{where}: must be at most {bounds['max']}, got {value}")
    if "above" in bounds and value <= bounds["above"]:
        raise ConfigError(f"{where}: must be above {bounds['above']}, got {value}")


def to_dict(config: Any) -> Any:
    """Nested plain values of a configuration, as YAML can write them."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_dict(getattr(config, f.name)) for f in dataclasses.fields(config) if f.compare}
    if isinstance(config, Mapping):
        return {k: to_dict(v) for k, v in config.items()}
    if isinstance(config, list | tuple):
        return [to_dict(v) for v in config]
    return config


def to_yaml(config: TaskConfig) -> str:
    """The full configuration as YAML that `load_config` reads back."""
    return yaml.safe_dump(to_dict(config), sort_keys=False, default_flow_style=None, width=120)
