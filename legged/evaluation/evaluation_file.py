"""What an evaluation's file holds, checked: it may come from anywhere."""

import math
from typing import Any

from legged.errors import ConfigError


def check(result: Any, where: str) -> None:
    """Check the fields of an evaluation that comparisons read; `where` names its file.

    Raises:
        ConfigError: one is missing, or of another type.
    """
    fields = _mapping(result, where, "the whole file")
    for name in ("task", "physics"):
        _text(fields, name, where, "")
    tracking, path = (fields["rough"], "rough.") if "rough" in fields else (fields, "")
    _mapping(tracking, where, "rough")
    _number(tracking, "falls", where, path)
    for name in ("rmse_lin", "rmse_ang"):
        for part in ("mean", "worst"):
            _number(_mapping(tracking.get(name), where, f"{path}{name}"), part, where, f"{path}{name}.", or_null=True)
    if "success" in fields:
        check_success(fields, where)


def check_success(result: Any, where: str) -> None:
    """Check the part that says how hard a terrain was crossed. Raises as `check`."""
    success = _mapping(_mapping(result, where, "the whole file").get("success"), where, "success")
    types = _mapping(success.get("types"), where, "success.types")
    for name, entry in types.items():
        path = f"success.types.{name}."
        _mapping(entry, where, path.rstrip("."))
        for text in ("unit", "what"):
            _text(entry, text, where, path)
        _number(entry, "trained_to", where, path, or_null=True)
        points = entry.get("points")
        if not isinstance(points, list):
            raise _wrong(where, f"{path}points", "a list", points)
        for i, point in enumerate(points):
            _mapping(point, where, f"{path}points[{i}]")
            for number in ("size", "share"):
                _number(point, number, where, f"{path}points[{i}].")


def tracking_of(result: dict[str, Any]) -> dict[str, Any]:
    """The part of a result that says how commands were followed."""
    return result.get("rough", result)


def _mapping(value: Any, where: str, path: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _wrong(where, path, "a mapping", value)
    return value


def _text(fields: dict[str, Any], name: str, where: str, path: str) -> None:
    if not isinstance(fields.get(name), str):
        raise _wrong(where, path + name, "a text", fields.get(name))


def _number(fields: dict[str, Any], name: str, where: str, path: str, or_null: bool = False) -> None:
    value = fields.get(name)
    if or_null and value is None and name in fields:
        return
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(where, path + name, "a number or null" if or_null else "a number", value)


def _wrong(where: str, path: str, wanted: str, value: Any) -> ConfigError:
    given = "nothing" if value is None else f"{type(value).__name__} {str(value)[:40]!r}"
    return ConfigError(f"{where}: is not the result of an evaluation: {path}: expected {wanted}, got {given}")
