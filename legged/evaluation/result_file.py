"""The file of an evaluation's result, read and checked: it may come from anywhere."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from legged.errors import ConfigError

CHANGED = "changed"
"""Folder, beside a policy's own results, for those of evaluations for which fields were changed."""
SAYS_NOTHING = ("sim.physics", "sim.solver", "sim.threads", "env.seed", "env.num_envs", "robot")
"""Fields that say where a policy is measured, not under what."""
SECTIONS_THAT_SAY_NOTHING = ("train.", "evaluation.")
"""Sections of such fields: of the grid of commands a result says what it is, by whatever way it was asked for."""


def changes_of(asked: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return field -> value of what was asked for that makes an evaluation another one than the policy's own."""
    said = ((field, value) for field, value in asked if field not in SAYS_NOTHING)
    return {field: value for field, value in said if not f"{field}.".startswith(SECTIONS_THAT_SAY_NOTHING)}


def file_name(engine: str) -> str:
    """Return what the result of an evaluation in an engine is called."""
    return f"evaluation_{engine}.json"


def stress_name(engine: str) -> str:
    """Return what the result of a stress test in an engine is called."""
    return f"stress_{engine}.json"


def kept_tracking(path: Path, head: dict[str, Any]) -> dict[str, Any]:
    """Return the tracking part of the file at `path`, if that is a result with the same `head`; nothing otherwise."""
    old = _same(path, head)
    return {name: value for name, value in old.items() if name not in (*head, "wall_s", "success")}


def kept_success(path: Path, head: dict[str, Any]) -> dict[str, Any]:
    """Return the success part of the file at `path`, if that is a result with the same `head`; nothing otherwise."""
    return {name: value for name, value in _same(path, head).items() if name == "success"}


def _same(path: Path, head: dict[str, Any]) -> dict[str, Any]:
    """Return the result at `path` if its head is the same, policy's file included; an empty one otherwise."""
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
        same = isinstance(old, dict) and all(old.get(name) == value for name, value in head.items())
    except (OSError, ValueError, RecursionError):
        return {}
    return old if same and ("changes" in old) == ("changes" in head) else {}


def read_results(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Read the results in files and folders; one that is named twice, itself and by its folder, counts once.

    Raises:
        ConfigError: a path is not there, holds no evaluation, or is none.
    """
    results: dict[Path, dict[str, Any]] = {}
    for path in paths:
        files = sorted(path.glob(file_name("*"))) if path.is_dir() else [path]
        if not files or not all(file.is_file() for file in files):
            raise ConfigError(f"{path}: holds no evaluation_<physics>.json; legged evaluate writes it")
        for file in files:
            try:
                result = json.loads(file.read_text(encoding="utf-8"))
            except (OSError, ValueError, RecursionError) as error:
                raise ConfigError(f"{file}: is not the result of an evaluation ({error})") from error
            check_result(result, str(file))
            results[file.resolve()] = result
    return list(results.values())


def check_result(result: Any, where: str) -> None:
    """Check the fields of an evaluation that comparisons read; `where` names its file.

    Raises:
        ConfigError: one is missing, or of another type.
    """
    fields = _mapping(result, where, "the whole file")
    for name in ("task", "physics"):
        _text(fields, name, where, "")
    _mapping(fields.get("changes", {}), where, "changes")
    if "episodes" in fields:
        check_episodes(fields, where)
        return
    tracking, path = (fields["rough"], "rough.") if "rough" in fields else (fields, "")
    _mapping(tracking, where, "rough")
    _number(tracking, "falls", where, path)
    for axis, values in _mapping(tracking.get("grid", {}), where, f"{path}grid").items():
        numbers = dict(enumerate(values)) if isinstance(values, list) else {}
        for i in numbers:
            _number({str(i): numbers[i]}, str(i), where, f"{path}grid.{axis}.")
        if not numbers:
            raise _wrong(where, f"{path}grid.{axis}", "a list of numbers", values)
    for name in ("rmse_lin", "rmse_ang"):
        for part in ("mean", "worst"):
            _number(_mapping(tracking.get(name), where, f"{path}{name}"), part, where, f"{path}{name}.", or_null=True)
    if "success" in fields:
        check_success(fields, where)


def check_episodes(result: Any, where: str) -> None:
    """Check the part that says what episodes of a task without commands came to. Raises as `check_result`."""
    episodes = _mapping(_mapping(result, where, "the whole file").get("episodes"), where, "episodes")
    for name in ("count", "failures"):
        _number(episodes, name, where, "episodes.")
    for name in ("return", "length"):
        for part in ("mean", "std", "min", "max"):
            _number(_mapping(episodes.get(name), where, f"episodes.{name}"), part, where, f"episodes.{name}.")
    for name in ("terms", "metrics"):
        for key in _mapping(episodes.get(name), where, f"episodes.{name}"):
            _number(episodes[name], key, where, f"episodes.{name}.")


def check_success(result: Any, where: str) -> None:
    """Check the part that says how hard a terrain was crossed. Raises as `check_result`."""
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
    """Return the part of a result that says how commands were followed."""
    return result.get("rough", result)


def changes_text(result: dict[str, Any]) -> str:
    """Return the changed fields of an evaluation in words, 'sim.dt=0.002, terrain.scan=own'; nothing of one without."""
    return ", ".join(f"{field}={value}" for field, value in sorted(result.get("changes", {}).items()))


def grid_text(result: dict[str, Any]) -> str:
    """Return the commands of an evaluation in words, 'vx -1 to 1, vy 0, yaw 0 (5 commands)'; nothing of one without."""
    grid = tracking_of(result).get("grid", {})
    ends = {axis: sorted({min(values), max(values)}) for axis, values in grid.items()}
    parts = [f"{axis} {' to '.join(f'{value:g}' for value in values)}" for axis, values in ends.items()]
    count = math.prod(map(len, grid.values()))
    return f"{', '.join(parts)} ({count} command{'s' if count > 1 else ''})" if grid else ""


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
