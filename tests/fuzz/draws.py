"""What the fuzzer draws: values of any kind, places in the configuration, and mutations of nested data and of text."""

import copy
import dataclasses
import typing
from typing import Any

from hypothesis import strategies as st

from legged.config import TaskConfig

NUMBERS = st.one_of(
    st.sampled_from([0, 1, -1, 2, 3, 7, 100, 10**6, 10**18, 2**63, 2**64, -(2**63), 10**400, 0.0, -0.0, 1e-320, 1e-45, 1e-9]),
    st.sampled_from([0.5, 1.5, 1e10, 3e38, 1e300, 1.7e308, -1e308, float("inf"), float("-inf"), float("nan")]),
    st.integers(-10, 1000),
    st.floats(-100.0, 100.0),
)
TEXTS = st.one_of(
    st.sampled_from(
        ["", " ", "a", "..", "../x", "/", "a/b", "\0", "\n", "[/x]", "[bold]", "{}", "%s", "~", ".hidden", "x" * 5000]
    ),
    st.sampled_from(["true", "none", "1e3", "anymal_c", "mujoco", "cuda", "-1", "é", "日本", "\u202e", "\ud7ff", "NaN"]),
    st.text(max_size=12),
)
LEAVES = st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=8,
)
"""Anything that YAML can hold."""


def fields(schema: type, prefix: str = "") -> dict[str, Any]:
    """Dotted path -> type, of every field of a configuration."""
    found: dict[str, Any] = {}
    hints = typing.get_type_hints(schema)
    for field in dataclasses.fields(schema):
        kind = hints[field.name]
        if dataclasses.is_dataclass(kind):
            found |= fields(kind, f"{prefix}{field.name}.")
        elif field.compare:
            found[prefix + field.name] = kind
    return found


FIELDS = fields(TaskConfig)


def values_of(kind: Any) -> st.SearchStrategy[Any]:
    """Values that are often of the right kind: wrong in size rather than in type."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return st.one_of(st.sampled_from(args), VALUES)
    if origin is tuple:
        inner = values_of(args[0])
        count = (0, 6) if args[-1] is Ellipsis else (len(args), len(args))
        return st.one_of(st.lists(inner, min_size=count[0], max_size=count[1]), VALUES)
    if origin is dict:
        return st.one_of(st.dictionaries(TEXTS, values_of(args[1]), max_size=3), VALUES)
    right: dict[Any, st.SearchStrategy[Any]] = {
        bool: st.booleans(),
        int: st.integers(-2, 200),
        float: st.floats(allow_nan=True, allow_infinity=True),
        str: TEXTS,
    }
    return st.one_of(right.get(kind, VALUES), NUMBERS, VALUES)


OVERRIDES = st.lists(
    st.sampled_from(sorted(set(FIELDS) - {"task"})).flatmap(lambda path: st.tuples(st.just(path), values_of(FIELDS[path]))),
    min_size=1,
    max_size=3,
)
"""Some (dotted path, value)."""


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to everything inside nested dictionaries and lists."""
    found = [path] if path else []
    if isinstance(data, dict):
        for key, value in data.items():
            found += places(value, (*path, key))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            found += places(value, (*path, i))
    return found


def mutated(data: Any, path: tuple[Any, ...], how: str, value: Any) -> Any:
    """A copy of nested data in which what lies at `path` is replaced, removed, or put under another name."""
    data = copy.deepcopy(data)
    inside = data
    for key in path[:-1]:
        inside = inside[key]
    if how == "replace":
        inside[path[-1]] = value
    elif how == "remove":
        del inside[path[-1]]
    elif isinstance(inside, dict):
        inside[str(value)[:50]] = inside.pop(path[-1])
    return data


HOW = st.sampled_from(["replace", "replace", "remove", "rename"])


@st.composite
def changed_text(draw: st.DrawFn, text: str, tokens: st.SearchStrategy[str]) -> str:
    """A text with a few lines dropped, doubled, moved, or with a token of theirs replaced."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 4))):
        i = draw(st.integers(0, max(len(lines) - 1, 0)))
        what = draw(st.sampled_from(["drop", "double", "swap", "token", "insert", "indent", "cut"]))
        if not lines:
            break
        if what == "drop":
            del lines[i]
        elif what == "double":
            lines.insert(i, lines[i])
        elif what == "swap":
            j = draw(st.integers(0, len(lines) - 1))
            lines[i], lines[j] = lines[j], lines[i]
        elif what == "token":
            words = lines[i].split(" ")
            words[draw(st.integers(0, len(words) - 1))] = draw(tokens)
            lines[i] = " ".join(words)
        elif what == "insert":
            lines.insert(i, draw(tokens))
        elif what == "indent":
            lines[i] = " " * draw(st.integers(0, 6)) + lines[i].strip()
        else:
            lines[i] = lines[i][: draw(st.integers(0, len(lines[i])))]
    return "\n".join(lines) + "\n"
