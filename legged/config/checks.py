"""Conversion of plain values to an instance of a schema, field by field. Every error names the dotted path of the value, and
the source of the value, such as a file.
"""

import dataclasses
import functools
import operator
import sys
import types
import typing
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, NamedTuple, TypeVar, Union

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
FINITE = f"from -{FLOAT32_MAX:g} to {FLOAT32_MAX:g}"
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


class _Place(NamedTuple):
    """Place of a value in a configuration, for errors."""

    path: str
    """Dotted path of the value; empty for the whole configuration."""
    origins: Origins
    """Sources of the settings. If it is empty, all values are from `source`."""
    source: str

    def at(self, key: Any) -> "_Place":
        """Return the place of the value of `key` in a map."""
        return self._replace(path=f"{self.path}.{plain_path(key)}" if self.path else plain_path(key))

    def error(self, text: str) -> ConfigError:
        origin = self.origins.of(self.path) if self.path and self.origins else self.source
        return ConfigError(f"{origin}: {self.path or 'top level'}: {text}")

    def expected(self, what: str, value: Any) -> ConfigError:
        return self.error(f"expected {what}, got {shown(value)}")


def build(
    schema: type[T],
    data: Any,
    source: str,
    origins: Origins | None = None,
    others: Collection[str] = (),
    path: str = "",
) -> T:
    """Build an instance of the dataclass `schema` from the mapping `data`, and check every field. A field that is missing in
    `data` gets its default.

    Args:
        schema: a dataclass, whose fields have bounds as metadata (bounds.py).
        data: nested plain values, such as those of a YAML file.
        source: source of the values, such as a file.
        origins: sources of single values. If it is empty or None, all values are from `source`.
        others: keys that an error about an unknown key lists too, in addition to the names of the fields.
        path: dotted path of `data` in its configuration; empty for a whole configuration.

    Raises:
        ConfigError: an unknown key, a wrong type, or a value beyond its bounds.
    """
    return _section(schema, data, _Place(path, origins or Origins(), source), others=others)


def _section(schema: type[T], data: Any, place: _Place, base: T | None = None, others: Collection[str] = ()) -> T:
    """Build an instance of `schema`. A field that is missing in `data` gets the value that it has in `base`. If `base` is
    None, the field gets its default.
    """
    if not isinstance(data, Mapping):
        raise place.expected(f"a mapping with keys of {schema.__name__}", data)
    fields = {f.name: f for f in dataclasses.fields(schema) if f.compare}  # type: ignore[arg-type]
    hints = hints_of(schema)  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key not in fields:
            known = suggest(plain_path(key), [*fields, *others])
            raise place.at(key).error(f"unknown key {shown(key)}{known}")
        factory = fields[key].default_factory
        # Maps are merged with the schema's default entries.
        entries = factory() if typing.get_origin(hints[key]) is dict and callable(factory) else None
        values[key] = _check(hints[key], value, place.at(key), fields[key].metadata, entries)
    return schema(**values) if base is None else dataclasses.replace(base, **values)  # type: ignore[type-var]


WORDS: dict[Any, tuple[Any, str]] = {
    float: ((int, float), "a number"),
    Literal: (str, "a name"),
    tuple: ((list, tuple), "[low, high]"),
    dict: (Mapping, "a mapping from names to numbers"),
    Mapping: (Mapping, "a mapping with the key range"),
}
"""Kind of an alternative in a union -> types of its values, and its description in an error. A section has the kind
Mapping."""
SCALARS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
"""Type of a single value -> its description in an error."""


def _kind_in_union(kind: Any) -> Any:
    """Return the key of WORDS that describes the values of a type."""
    origin = typing.get_origin(kind)
    return Mapping if dataclasses.is_dataclass(kind) else origin if origin in WORDS else float


def _check(kind: Any, value: Any, place: _Place, bounds: Mapping[str, Any], default: Any = None) -> Any:
    """Return `value` as the type `kind`, or raise ConfigError. Integers become floats where `kind` is float, lists become
    tuples, and nothing else is converted. All numbers and texts in the value are checked against `bounds`. A section or a map
    is completed with the fields or entries of `default`.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return _check_free(value, functools.partial(place.expected, value=value))
    if dataclasses.is_dataclass(kind):
        return _section(typing.cast(type, kind), value, place, default)
    if origin is Literal:
        if not isinstance(value, str) or value not in args:
            known = suggest(value if isinstance(value, str) else shown(value), args)
            raise place.error(f"unknown value {shown(value)}{known}")
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        kinds = [a for a in args if a is not type(None)]
        fitting = [a for a in kinds if isinstance(value, WORDS[_kind_in_union(a)][0])] if len(kinds) > 1 else kinds
        if not fitting:
            named = {_kind_in_union(a) for a in kinds}
            raise place.expected(", or ".join(words for one, (_, words) in WORDS.items() if one in named), value)
        return _check(fitting[0], value, place, bounds)
    if origin is tuple:
        return _check_list(args, value, place, bounds)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise place.expected("a mapping", value)
        for key in value:
            if not isinstance(key, str):
                raise place.expected(f"a mapping whose keys are text (one key is {shown(key)})", value)
        default = default or {}
        return {**default, **{k: _check(args[1], v, place.at(k), bounds, default.get(k)) for k, v in value.items()}}
    if kind not in SCALARS:
        return value
    if not isinstance(value, (int, float) if kind is float else kind) or (isinstance(value, bool) and kind is not bool):
        raise place.expected(SCALARS[kind], value)
    if kind is float and not abs(value) <= sys.float_info.max:  # also refuses NaN
        raise place.expected("a number" if value != value else f"a finite number, {FINITE}", value)
    value = float(value) if kind is float else str.__str__(value) if kind is str else value
    _check_bounds(value, bounds, place)
    return value


def _check_list(kinds: tuple[Any, ...], value: Any, place: _Place, bounds: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return a list as a tuple whose items have the types `kinds`. The types (kind, ...) allow any number of items."""
    if not isinstance(value, list | tuple):
        raise place.expected("a list", value)
    each = kinds[:1] * len(value) if kinds[1:] == (Ellipsis,) else kinds
    if len(value) != len(each):
        raise place.expected(f"a list of {len(each)} numbers", value)
    items = [place._replace(path=f"{place.path}[{i}]") for i in range(len(value))]
    checked = tuple(_check(*one, bounds) for one in zip(each, value, items, strict=True))
    if kinds in ((float, float), (int, int)) and checked[0] > checked[1]:
        raise place.expected("[low, high] with low <= high", value)
    if bounds and not checked and "may_be_empty" not in bounds:
        raise place.error("must not be empty")
    if len(checked) > bounds.get("items", len(checked)):
        raise place.error(f"must have at most {bounds['items']} items, got {len(checked)}")
    twice = next((item for i, item in enumerate(checked) if item in checked[:i]), None) if bounds.get("unique") else None
    if twice is not None:
        raise place.error(f"{shown(twice)} is named twice")
    return checked


def _check_free(value: Any, fail: Callable[[str], ConfigError], depth: int = 0) -> Any:
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
    if value is None or isinstance(value, bool | str):
        return value
    if not isinstance(value, int | float):
        raise fail("a number, a text, true, false, null, or a list or map of these")
    if not abs(value) <= FLOAT32_MAX:
        raise fail(f"finite numbers, {FINITE}")
    return int(value) if isinstance(value, int) else float(value)  # YAML can't write NumPy numbers


LIMITS = {"above": (operator.le, "above"), "min": (operator.lt, "at least"), "max": (operator.gt, "at most")}
"""Key of a bound -> test whether a number is beyond the bound, and its word in an error."""


def _check_bounds(value: Any, bounds: Mapping[str, Any], place: _Place) -> None:
    """Check a number or a text against the bounds of its field."""
    if isinstance(value, str):
        if "name" in bounds and value and not is_plain_name(value):
            raise place.error(f"expected {PLAIN}; got {shown(value)}")
        return
    for key, (is_beyond, word) in LIMITS.items():
        if key in bounds and is_beyond(value, bounds[key]):
            raise place.error(f"must be {word} {bounds[key]}, got {shown(value)}")
