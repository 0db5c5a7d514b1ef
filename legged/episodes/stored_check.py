"""Stored episodes, checked: they may come from anywhere, and everything that reads them relies on their shapes and names."""

import math
from typing import Any

import numpy as np

from legged.errors import ConfigError

FORMAT = 1
"""Of episodes.json; grows when older files can't be read any more."""
PER_EPISODE = {
    "episode_start": "first row of every episode, and behind the last one",
    "robot": "which robot ran it",
    "failed": "it ended in a failure",
    "timed_out": "it ended by time, or by a term that is nobody's fault",
    "ended_by": "which terms ended it, in the order of `terminations`",
    "first_qpos": "generalised positions before the first step",
    "first_qvel": "and velocities",
}
"""Arrays of a row an episode; all others have a row a control step, of one episode after the other."""
ALWAYS = ("qpos", "qvel", "action", "reward", "reward_parts")
LEGS = ("base_lin_vel", "base_ang_vel", "ground", "command", "feet_pos", "feet_force", "feet_contact", "contact_force")
"""Arrays that legged robots have beside these and those of joints, all or none."""
JOINTS = ("joint_pos", "joint_vel", "torque")


def check_stored(about: Any, arrays: dict[str, np.ndarray], where: str) -> None:
    """Check what episodes.json says, and that the arrays of episodes.npz are as it says; `where` names the folder.

    Raises:
        ConfigError: something is missing, of another type, or does not fit the rest.
    """
    about = _mapping(about, where, "the whole file")
    if about.get("format") != FORMAT or isinstance(about["format"], bool):
        raise _wrong(where, "format", str(FORMAT), about.get("format"))
    for name in ("task", "checkpoint", "run"):
        _text(about.get(name), where, name)
    for name in ("dt", "reward_unit"):
        _positive(about.get(name), where, name)
    terms = _texts(about.get("terminations"), where, "terminations")
    described = _mapping(about.get("arrays"), where, "arrays")
    legged = "command" in arrays
    required = (*PER_EPISODE, *ALWAYS, *((*LEGS, *JOINTS) if legged else ()))
    missing = [name for name in required if name not in arrays]
    if missing:
        raise ConfigError(f"{where}: the episodes there are damaged: {', '.join(missing)} missing")
    count, rows = _check_starts(arrays, where)
    for name, array in arrays.items():
        wanted = count + (name == "episode_start") if name in PER_EPISODE else rows
        if array.ndim == 0 or array.dtype.kind not in "biuf" or len(array) != wanted:
            got = f"shape {array.shape} of {array.dtype}"
            raise ConfigError(
                f"{where}: the episodes there are damaged: {name}: expected {wanted} rows of numbers, got {got}"
            )
        if name not in PER_EPISODE:
            _check_columns(name, array, described, where)
    if arrays["ended_by"].shape != (count, len(terms)):
        raise _wrong(where, "terminations", f"{arrays['ended_by'].shape[1:]} texts", terms)
    _check_joints(about, arrays, where)
    if legged:
        _check_legs(about, arrays, where)
    ground = about.get("ground")
    if ground is not None:
        entry = _mapping(ground, where, "ground")
        if not isinstance(entry.get("terrain"), str | None):
            raise _wrong(where, "ground.terrain", "a text or null", entry["terrain"])
        if entry.get("difficulty") is not None:
            _number(entry["difficulty"], where, "ground.difficulty")
    _mapping(about.get("changes", {}), where, "changes")
    held = about.get("held_command")
    if held is not None:
        for value in _list(held, where, "held_command"):
            _number(value, where, "held_command")


def _check_starts(arrays: dict[str, np.ndarray], where: str) -> tuple[int, int]:
    """Return how many episodes and rows there are."""
    start, failed = arrays["episode_start"], arrays["failed"]
    count = len(failed) if failed.ndim == 1 else 0
    right = start.shape == (count + 1,) and start.dtype.kind in "iu" and count > 0
    if not right or start[0] != 0 or (start[1:] <= start[:-1]).any():
        raise ConfigError(f"{where}: the episodes there are damaged: episode_start does not say where {count} episodes begin")
    return count, int(start[-1])


def _check_columns(name: str, array: np.ndarray, described: dict[str, Any], where: str) -> None:
    """Check that the columns of an array are named."""
    path = f"arrays.{name}"
    columns = _texts(_mapping(described.get(name), where, path).get("columns"), where, f"{path}.columns")
    shape = (len(columns),) if columns or array.ndim > 1 else ()
    if array.shape[1:] not in (shape, (*shape, 3)):
        raise _wrong(where, f"{path}.columns", f"names for an array of shape {array.shape}", columns)


def _check_joints(about: dict[str, Any], arrays: dict[str, np.ndarray], where: str) -> None:
    joints = _list(about.get("joints"), where, "joints")
    for i, joint in enumerate(joints):
        path = f"joints[{i}]"
        entry = _mapping(joint, where, path)
        _text(entry.get("name"), where, f"{path}.name")
        if entry.get("unit") not in ("rad", "m"):
            raise _wrong(where, f"{path}.unit", "rad or m", entry.get("unit"))
        for column in ("qpos", "qvel"):
            number = entry.get(column)
            if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < arrays[column].shape[1]:
                raise _wrong(where, f"{path}.{column}", f"a column of {column}", number)
        missing = [limit for limit in ("range", "max_velocity", "max_torque") if limit not in entry]
        if missing:
            raise _wrong(where, f"{path}.{missing[0]}", "it, or null", None)
        for limit in ("max_velocity", "max_torque"):
            if entry.get(limit) is not None:
                _positive(entry[limit], where, f"{path}.{limit}")
        if entry.get("range") is not None:
            pair = _list(entry["range"], where, f"{path}.range")
            for value in pair:
                _number(value, where, f"{path}.range")
            if len(pair) != 2:
                raise _wrong(where, f"{path}.range", "two numbers", pair)
    for name in JOINTS:
        if name in arrays and arrays[name].shape[1:] != (len(joints),):
            raise _wrong(where, "joints", f"{arrays[name].shape[1:]} of them, as {name} has", len(joints))


def _check_legs(about: dict[str, Any], arrays: dict[str, np.ndarray], where: str) -> None:
    _positive(about.get("contact_threshold"), where, "contact_threshold")
    feet, contacts = (len(_texts(about.get(name), where, name)) for name in ("feet", "contacts"))
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("base_lin_vel", "base_ang_vel", "command"), (3,)),
        **dict.fromkeys(("feet_pos", "feet_force"), (feet, 3)),
        "ground": (),
        "feet_contact": (feet,),
        "contact_force": (contacts,),
    }
    for name, shape in shapes.items():
        got = arrays[name].shape[1:]
        if feet == 0 or got != shape:
            raise ConfigError(f"{where}: the episodes there are damaged: {name}: expected rows of shape {shape}, got {got}")
    if arrays["qpos"].shape[1:] < (7,):
        raise ConfigError(f"{where}: the episodes there are damaged: qpos has no place for a floating base")


def _mapping(value: Any, where: str, path: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _wrong(where, path, "a mapping", value)
    return value


def _list(value: Any, where: str, path: str) -> list[Any]:
    if not isinstance(value, list):
        raise _wrong(where, path, "a list", value)
    return value


def _text(value: Any, where: str, path: str) -> None:
    if not isinstance(value, str):
        raise _wrong(where, path, "a text", value)


def _texts(value: Any, where: str, path: str) -> list[str]:
    for one in _list(value, where, path):
        _text(one, where, path)
    return value  # type: ignore[no-any-return]


def _number(value: Any, where: str, path: str) -> float:
    """Return a number that a 32-bit float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e30:
        raise _wrong(where, path, "a number", value)
    return float(value)


def _positive(value: Any, where: str, path: str) -> None:
    if not 1e-9 < _number(value, where, path) < math.inf:
        raise _wrong(where, path, "a number above 0", value)


def _wrong(where: str, path: str, wanted: str, value: Any) -> ConfigError:
    given = "nothing" if value is None else f"{type(value).__name__} {str(value)[:40]!r}"
    return ConfigError(f"{where}: the episodes there are damaged: {path}: expected {wanted}, got {given}")
