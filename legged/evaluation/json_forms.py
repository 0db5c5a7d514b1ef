"""Checks of the form of values from JSON files. A file may be damaged, or another program may have written it."""

from dataclasses import dataclass
from typing import Any

from legged.errors import ConfigError

TEXT, NUMBER, POSITIVE, INDEX = "a text", "a number", "a number above 0", "a whole number of at least 0"
"""Forms of single values. The magnitude of all numbers must be below LARGEST, and a POSITIVE number must exceed SMALLEST."""
ANY = "*"
"""In a form that describes a mapping, this key stands for all names of the mapping."""
LARGEST, SMALLEST = 1e30, 1e-9
ABSENT = object()
"""Stands for the value of a name that a mapping lacks."""


@dataclass(frozen=True)
class OrNull:
    """Form of a value that may be null and otherwise has the form `form`."""

    form: Any


def check_form(value: Any, form: Any, damaged: str, path: str = "", or_null: str = "") -> None:
    """Check that a value has a form. `path` is the value's place in its file, for the message.

    `form` is one of the constants above, a set of allowed values, or an `OrNull`. A list of values is described by [form], by
    [form, ...] if it must not be empty, or by a tuple with a form for each entry. A mapping is described by a mapping from
    names to forms; a name that ends in ? may be absent. Messages add the text `or_null` to the name of the form.

    Raises:
        ConfigError: the value has another form. The message begins with `damaged`, which names the file and its damage.
    """

    def demand(right: bool, wanted: str) -> None:
        if not right:
            raise wrong_form(damaged, path or "the whole file", wanted + or_null, value)

    match form:
        case OrNull(inner):
            if value is not None:
                check_form(value, inner, damaged, path, " or null")
        case dict():
            demand(isinstance(value, dict), "a mapping")
            for name, inner in form.items():
                for key in value if name == ANY else [name.removesuffix("?")]:
                    if key in value or not name.endswith("?"):
                        check_form(value.get(key, ABSENT), inner, damaged, f"{path}.{key}".lstrip("."))
        case list() | tuple():
            demand(isinstance(value, list), "a list")
            demand(isinstance(form, list) or len(value) == len(form), f"a list of {len(form)}")
            demand(bool(value) or form[-1] is not Ellipsis, "a list with entries")
            for i, one in enumerate(value):
                check_form(one, form[i] if isinstance(form, tuple) else form[0], damaged, f"{path}[{i}]")
        case set():
            known = isinstance(value, int | str) and not isinstance(value, bool) and value in form
            demand(known, " or ".join(map(str, sorted(form))))
        case _:
            number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
            good = {
                TEXT: isinstance(value, str),
                NUMBER: number,
                POSITIVE: number and value > SMALLEST,
                INDEX: number and isinstance(value, int) and value >= 0,
            }
            demand(good[form], form)


def wrong_form(damaged: str, path: str, wanted: str, value: Any) -> ConfigError:
    """Return the error for a value whose form is not `wanted`."""
    given = "nothing" if value is None or value is ABSENT else f"{type(value).__name__} {str(value)[:40]!r}"
    return ConfigError(f"{damaged}: {path}: expected {wanted}, got {given}")
