"""Conversion of plain values to an instance of a schema, field by field. Every error names the dotted path of the value, and
the source of the value, such as a file.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, Union

from legged.config.bounds import FLOAT32_MAX
from legged.config.origins import Origins
from legged.errors import ConfigError, suggest

T = TypeVar("T")

LONGEST_NAME = 100
"""Longest name of a folder, in characters."""
DEEPEST = 30
"""Deepest allowed nesting of maps and lists in a configuration."""
SHOWN = 80
"""Longest text of a value in an error, in characters."""
PLAIN = "a plain name: no path separators, not '..', no leading '.', no control characters, at most 100 letters"


@functools.cache
def hints_of(schema: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields: name -> type."""
    return typing.get_type_hints(schema)


def shown(value: Any) -> str:
    """Return a value as text for an error, on one line and cut if it is long."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write integers of more than 4300 digits
        return f"a whole number of {value.bit_length()} bits" if isinstance(value, int) else type(value).__name__
    text = " ".join(text.split())
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}... ({len(text)} letters)"


def plain_path(key: Any) -> str:
    """Return a key as part of a dotted path in an error. A long or unprintable key is cut or escaped."""
    return key if isinstance(key, str) and key and key.isprintable() and len(key) <= SHOWN else shown(key)


def is_plain_name(name: str) -> bool:
    """Return True if `name` is a valid folder name on every system."""
    if not name or not name.isprintable() or name.startswith(".") or name != name.strip():
        return False
    return not any(mark in name for mark in "/\\") and len(name) <= LONGEST_NAME and len(name.encode()) <= 2 * LONGEST_NAME


def build(schema: type[T], data: Any, path: str, origins: Origins, source: str, base: T | None = None) -> T:
    """Build an instance of the dataclass `schema` from the mapping `data`, and check every field. A field that is missing in
    `data` gets the value that it has in `base`. If `base` is None, the field gets its default.

    Raises:
        ConfigError: an unknown key, a wrong type, or a value beyond its bounds.
    """
    where = f"{_origin(path, origins, source)}: {path or 'top level'}"
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: expected a mapping with keys of {schema.__name__}, got {shown(data)}")
    fields = {f.name: f for f in dataclasses.fields(schema) if f.compare}  # type: ignore[arg-type]
    hints = hints_of(schema)  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in data.items():
        shown_key = plain_path(key)
        dotted = f"{path}.{shown_key}" if path else shown_key
        if key not in fields:
            known = suggest(shown_key, fields)
            raise ConfigError(f"{_origin(dotted, origins, source)}: {dotted}: unknown key {shown(key)}{known}")
        if dataclasses.is_dataclass(hints[key]):
            values[key] = build(hints[key], value, dotted, origins, source)  # type: ignore[arg-type]
            continue
        is_map = typing.get_origin(hints[key]) is dict
        factory = fields[key].default_factory
        entries = factory() if is_map and callable(factory) else {}
        if is_map and dataclasses.is_dataclass(typing.get_args(hints[key])[1]):
            checked = _build_entries(typing.get_args(hints[key])[1], value, dotted, origins, source, entries)
        else:
            checked = _check(hints[key], value, dotted, origins, source)
        if fields[key].metadata:
            _check_bounds(checked, fields[key].metadata, dotted, f"{_origin(dotted, origins, source)}: ")
        values[key] = {**entries, **checked} if is_map else checked  # maps are merged with the schema's default entries
    return schema(**values) if base is None else dataclasses.replace(base, **values)  # type: ignore[type-var]


def _build_entries(
    schema: Any, data: Any, path: str, origins: Origins, source: str, entries: Mapping[str, Any]
) -> dict[str, Any]:
    """Build each section of the map `data`. A field that a section lacks gets its value from the section with the same name
    in `entries`, or its default if `entries` has no such section.
    """
    names = _check(dict[str, object], data, path, origins, source)  # only keys are checked here; `build` checks the values
    return {
        name: build(schema, data[name], f"{path}.{plain_path(name)}", origins, source, entries.get(name)) for name in names
    }


def _origin(path: str, origins: Origins, source: str) -> str:
    """Return the source that `origins` records for `path`. If `origins` or `path` is empty, return `source`."""
    return origins.of(path) if path and origins else source


WORDS = {
    float: "a number",
    Literal: "a name",
    tuple: "[low, high]",
    dict: "a mapping from names to numbers",
    Mapping: "a mapping with the key range",
}
"""Kind of value -> its description in an error."""


def _shape(kind: Any) -> Any:
    """Return the key of WORDS that describes the values of a type."""
    origin = typing.get_origin(kind)
    return Mapping if dataclasses.is_dataclass(kind) else origin if origin in (Literal, tuple, dict) else float


def _has_shape(kind: Any, value: Any) -> bool:
    looks_like: dict[Any, Any] = {float: (int, float), Literal: str, tuple: (list, tuple), dict: Mapping, Mapping: Mapping}
    return isinstance(value, looks_like[_shape(kind)])


def _check(kind: Any, value: Any, path: str, origins: Origins, source: str) -> Any:
    """Return `value` as the type `kind`, or raise ConfigError. Integers become floats where `kind` is float, lists become
    tuples, and nothing else is converted.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)

    def fail(expected: str) -> ConfigError:
        return ConfigError(f"{_origin(path, origins, source)}: {path}: expected {expected}, got {shown(value)}")

    if kind is Any:
        return _check_free(value, fail)
    if origin is Literal:
        if not isinstance(value, str) or value not in args:
            known = suggest(value if isinstance(value, str) else shown(value), args)
            raise ConfigError(f"{_origin(path, origins, source)}: {path}: unknown value {shown(value)}{known}")
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        kinds = [a for a in args if a is not type(None)]
        fitting = [a for a in kinds if _has_shape(a, value)] if len(kinds) > 1 else kinds
        if not fitting:
            raise fail(", or ".join(WORDS[_shape(a)] for a in sorted(kinds, key=lambda a: list(WORDS).index(_shape(a)))))
        if dataclasses.is_dataclass(fitting[0]):
            return build(fitting[0], value, path, origins, source)  # type: ignore[arg-type]
        return _check(fitting[0], value, path, origins, source)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise fail("a list")
        if len(args) == 2 and args[1] is Ellipsis:
            return tuple(_check(args[0], v, f"{path}[{i}]", origins, source) for i, v in enumerate(value))
        if len(value) != len(args):
            raise fail(f"a list of {len(args)} numbers")
        checked = tuple(_check(args[i], v, f"{path}[{i}]", origins, source) for i, v in enumerate(value))
        if args in ((float, float), (int, int)) and checked[0] > checked[1]:
            raise fail("[low, high] with low <= high")
        return checked
    if origin is dict:
        if not isinstance(value, Mapping):
            raise fail("a mapping")
        for key in value:
            if not isinstance(key, str):
                raise fail(f"a mapping whose keys are text (one key is {shown(key)})")
        return {k: _check(args[1], v, f"{path}.{plain_path(k)}", origins, source) for k, v in value.items()}
    if kind is bool:
        if not isinstance(value, bool):
            raise fail("true or false")
    elif kind is int:
        if not isinstance(value, int) or isinstance(value, bool):
            raise fail("a whole number")
    elif kind is float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise fail("a number")
        return _number(value, fail)
    elif kind is str:
        if not isinstance(value, str):
            raise fail("text")
        return str.__str__(value)
    return value


def _number(value: float, fail: Any) -> float:
    """Return a number as a finite float."""
    if value != value:
        raise fail("a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if math.isinf(number):
        raise fail(f"a finite number, from -{FLOAT32_MAX:g} to {FLOAT32_MAX:g}")
    return number  # `build` checks the field's bounds later


def _check_free(value: Any, fail: Any, depth: int = 0) -> Any:
    """Return a copy of a value whose field has the type `Any`, e.g. in the section `custom`. The value may be anything that
    YAML can write and read, except NaN and infinite numbers.
    """
    if depth > DEEPEST:
        raise fail(f"at most {DEEPEST} nested maps and lists")
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str | int):
                raise fail(f"a mapping whose keys are text or whole numbers (one key is {shown(key)})")
        return {key: _check_free(item, fail, depth + 1) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_check_free(item, fail, depth + 1) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        if value != value or not abs(value) <= FLOAT32_MAX:
            raise fail(f"finite numbers, from -{FLOAT32_MAX:g} to {FLOAT32_MAX:g}")
        return int(value) if isinstance(value, int) else float(value)  # YAML can't write NumPy numbers
    elif value is not None and not isinstance(value, bool | str):
        raise fail("a number, a text, true, false, null, or a list or map of these")
    return value


def _check_bounds(value: Any, bounds: Mapping[str, Any], path: str, origin: str) -> None:
    """Check a value, and all items in it, against the bounds of its field."""
    if dataclasses.is_dataclass(value):
        return  # a section's fields have their own bounds
    if isinstance(value, tuple):
        _check_length(value, bounds, f"{origin}{path}")
        for i, item in enumerate(value):
            _check_bounds(item, bounds, f"{path}[{i}]", origin)
        return
    if isinstance(value, Mapping):
        for key, item in value.items():
            _check_bounds(item, bounds, f"{path}.{plain_path(key)}", origin)
        return
    where = f"{origin}{path}"
    if isinstance(value, str):
        if "name" in bounds and value and not is_plain_name(value):
            raise ConfigError(f"{where}: expected {PLAIN}; got {shown(value)}")
        return
    if "above" in bounds and value <= bounds["above"]:
        raise ConfigError(f"{where}: must be above {bounds['above']}, got {shown(value)}")
    if "min" in bounds and value < bounds["min"]:
        raise ConfigError(f"{where}: must be at least {bounds['min']}, got {shown(value)}")
    if "max" in bounds and value > bounds["max"]:
        raise ConfigError(f"{where}: must be at most {bounds['max']}, got {shown(value)}")


def _check_length(value: Sequence[Any], bounds: Mapping[str, Any], where: str) -> None:
    if not value and not bounds.get("may_be_empty"):
        raise ConfigError(f"{where}: must not be empty")
    if len(value) > bounds.get("items", len(value)):
        raise ConfigError(f"{where}: must have at most {bounds['items']} items, got {len(value)}")
    if bounds.get("unique"):
        twice = next((item for i, item in enumerate(value) if item in value[:i]), None)
        if twice is not None:
            raise ConfigError(f"{where}: {shown(twice)} is named twice")
