"""Path, type, default, unit, bounds and meaning of each field of a schema, for the reference pages and shell completion."""

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Union

from legged.config.bounds import SMALLEST
from legged.config.checks import SCALARS, hints_of
from legged.config.loader import to_dict


@dataclass(frozen=True)
class FieldText:
    """Description of one field of a configuration."""

    path: str
    """Dotted path, as on the command line; `<name>` stands for the name of an entry in a map."""
    kind: str
    """Accepted values, such as "a number" or "one of P, V, T"."""
    default: Any
    """Default as plain values; None for a section, because each of its fields has a default."""
    unit: str
    """Unit that `quantity` or `rescaled` (bounds.py) declares; empty without such a unit."""
    bounds: str
    """Bounds of the field's numbers, in words; empty if they have no bounds."""
    meaning: str
    """Docstring of the field, on one line."""
    choices: tuple[str, ...] = ()
    """All values that the field can have; empty if they cannot be listed."""
    is_section: bool = False
    """True if the field is a section. `fields` yields the section's own fields after it."""


def fields(schema: type, defaults: Any = None, prefix: str = "") -> Iterator[FieldText]:
    """Yield all settings of a schema, each section before its own fields. A map of sections has one entry, named `<name>`."""
    instance = schema() if defaults is None else defaults
    for field in dataclasses.fields(schema):  # type: ignore[arg-type]
        if not field.compare or field.name == "task":
            continue
        path, value = f"{prefix}{field.name}", getattr(instance, field.name)
        hint = hints_of(schema)[field.name]
        meaning = meaning_of(schema, field.name)
        of_entries = typing.get_args(hint)[1] if typing.get_origin(hint) is dict else None
        is_map = dataclasses.is_dataclass(of_entries)
        if is_map or dataclasses.is_dataclass(hint):
            path, kind, value = (f"{path}.<name>", of_entries, None) if is_map else (path, hint, value)
            yield FieldText(path, "a section", None, "", "", meaning, is_section=True)
            yield from fields(typing.cast(type, kind), value, f"{path}.")
        else:
            literals = [kind for kind in (hint, *typing.get_args(hint)) if typing.get_origin(kind) is Literal]
            choices = ("true", "false") if hint is bool else typing.get_args(literals[0]) if literals else ()
            unit, bounds = field.metadata.get("unit", ""), bounds_of(field.metadata)
            yield FieldText(path, kind_of(hint), to_dict(value), unit, bounds, meaning, choices)


@functools.cache
def _meanings(schema: type) -> dict[str, str]:
    """Return field -> docstring for the fields that a class itself declares."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node, after in zip(tree.body, tree.body[1:], strict=False):
        documented = (
            isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str)
        )
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and documented:
            found[node.target.id] = " ".join(ast.literal_eval(after.value).split())  # type: ignore[attr-defined]
    return found


def meaning_of(schema: type, name: str) -> str:
    """Return the docstring of a field in `schema`, or else in the nearest base class; '' for a field without a docstring."""
    classes = [kind for kind in schema.__mro__ if dataclasses.is_dataclass(kind)]
    return next((_meanings(kind)[name] for kind in classes if name in _meanings(kind)), "")


def kind_of(hint: Any) -> str:
    """Describe in words the values that a field of the type `hint` accepts."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return f"one of {', '.join(f'`{arg}`' for arg in args)}"
    if origin in (Union, types.UnionType):
        kinds = [kind_of(arg) for arg in args if arg is not type(None)]
        return " or ".join([*kinds, *(["`null`"] if type(None) in args else [])])
    if origin is tuple and args[1:] == (Ellipsis,):
        return f"a list: {kind_of(args[0])} each"
    if origin is tuple:
        return f"[low, high]: {len(args)} numbers" if len(args) == 2 else f"a list of {len(args)} numbers"
    if dataclasses.is_dataclass(hint):
        return "a mapping"
    if origin is dict:
        return f"a map: {kind_of(args[1])} for each name"
    return {**SCALARS, Any: "anything"}[hint]


def bounds_of(metadata: Mapping[str, Any]) -> str:
    """Describe in words the bounds in the metadata of a field; '' without bounds."""
    low, high = metadata.get("min"), metadata.get("max")
    parts = []
    if "above" in metadata and high is not None:
        least = f"above {metadata['above']}" if low is None or low <= SMALLEST else f"at least {_number(low)}"
        parts.append(f"{least}, at most {_number(high)}")
    elif low is not None and high is not None:
        parts.append(f"at most {_number(high)} in size" if low == -high else f"{_number(low)} to {_number(high)}")
    if "items" in metadata:
        parts.append(f"{0 if metadata.get('may_be_empty') else 1} to {metadata['items']} items")
    if metadata.get("unique"):
        parts.append("without duplicates")
    if metadata.get("name"):
        parts.append("a name that a folder can have")
    return ", ".join(parts)


def _number(value: float) -> str:
    """Return a bound as short text. Whole numbers of up to seven digits are exact."""
    return f"{value:.7g}" if isinstance(value, int) else f"{value:g}"
