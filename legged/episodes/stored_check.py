"""Checks of stored episodes, which may come from anywhere; their readers rely on shapes and names."""

from typing import Any

import numpy as np

from legged.errors import ConfigError
from legged.evaluation.json_forms import INDEX, NUMBER, POSITIVE, TEXT, OrNull, check_form, wrong_form

FORMAT = 1
"""Version of episodes.json. A new version means that older files can no longer be read."""
PER_EPISODE = {
    "episode_start": "first row of every episode, and behind the last one",
    "robot": "robot that ran it",
    "failed": "it ended in a failure",
    "timed_out": "it ended by time, or by a term that is no failure",
    "ended_by": "terms that ended it, in the order of `terminations`",
    "first_qpos": "generalised positions before the first step",
    "first_qvel": "and velocities",
}
"""Arrays with one row for each episode. The others have one row for each control step, one episode after the other."""
ALWAYS = ("qpos", "qvel", "action", "reward", "reward_parts")
LEGS = ("base_lin_vel", "base_ang_vel", "ground", "command", "feet_pos", "feet_force", "feet_contact", "contact_force")
"""Arrays of legged robots, besides those above and those of joints."""
JOINTS = ("joint_pos", "joint_vel", "torque")
JOINT = {
    "name": TEXT,
    "unit": {"rad", "m"},
    **dict.fromkeys(("qpos", "qvel"), INDEX),
    "range": OrNull((NUMBER, NUMBER)),
    **dict.fromkeys(("max_velocity", "max_torque"), OrNull(POSITIVE)),
}
FORM: dict[str, Any] = {
    "format": {FORMAT},
    **dict.fromkeys(("task", "checkpoint", "run"), TEXT),
    **dict.fromkeys(("dt", "reward_unit"), POSITIVE),
    "terminations": [TEXT],
    "joints": [JOINT],
    "ground?": OrNull({"terrain?": OrNull(TEXT), "difficulty?": OrNull(NUMBER)}),
    "changes?": {},
    "held_command?": OrNull([NUMBER]),
}
"""Form of episodes.json."""
LEGGED_FORM = {"contact_threshold": POSITIVE, "feet": [TEXT, ...], "contacts": [TEXT]}
"""Form of the parts that only legged robots have."""


def check_stored(about: Any, arrays: dict[str, np.ndarray], where: str) -> None:
    """Check episodes.json, and that the arrays of episodes.npz fit it; `where` names the folder.

    Raises:
        ConfigError: something is missing, has another type, or does not fit the rest.
    """
    damaged, legged = f"{where}: the episodes there are damaged", "command" in arrays
    of_steps = [name for name in arrays if name not in PER_EPISODE]
    check_form(about, FORM | (LEGGED_FORM if legged else {}), damaged)
    check_form(about, {"arrays": {name: {"columns": [TEXT]} for name in of_steps}}, damaged)
    required = (*PER_EPISODE, *ALWAYS, *((*LEGS, *JOINTS) if legged else ()))
    missing = [name for name in required if name not in arrays]
    if missing:
        raise ConfigError(f"{damaged}: {', '.join(missing)} missing")
    count, rows = _check_starts(arrays, damaged)
    for name, array in arrays.items():
        wanted = count + (name == "episode_start") if name in PER_EPISODE else rows
        if array.ndim == 0 or array.dtype.kind not in "biuf" or len(array) != wanted:
            got = f"shape {array.shape} of {array.dtype}"
            raise ConfigError(f"{damaged}: {name}: expected {wanted} rows of numbers, got {got}")
    for name in of_steps:
        columns, shape = about["arrays"][name]["columns"], arrays[name].shape[1:]
        named = (len(columns),) if columns or shape else ()
        if shape not in (named, (*named, 3)):
            raise wrong_form(damaged, f"arrays.{name}.columns", f"names for an array of shape {arrays[name].shape}", columns)
    if arrays["ended_by"].shape != (count, len(about["terminations"])):
        raise wrong_form(damaged, "terminations", f"{arrays['ended_by'].shape[1:]} texts", about["terminations"])
    for i, joint in enumerate(about["joints"]):
        for column in ("qpos", "qvel"):
            if joint[column] >= arrays[column].shape[1]:
                raise wrong_form(damaged, f"joints[{i}].{column}", f"a column of {column}", joint[column])
    for name in JOINTS:
        if name in arrays and arrays[name].shape[1:] != (len(about["joints"]),):
            raise wrong_form(damaged, "joints", f"{arrays[name].shape[1:]} of them, as {name} has", len(about["joints"]))
    if legged:
        _check_legs(about, arrays, damaged)


def _check_starts(arrays: dict[str, np.ndarray], damaged: str) -> tuple[int, int]:
    """Return the numbers of episodes and rows."""
    start, failed = arrays["episode_start"], arrays["failed"]
    count = len(failed) if failed.ndim == 1 else 0
    right = start.shape == (count + 1,) and start.dtype.kind in "iu" and count > 0
    if not right or start[0] != 0 or (start[1:] <= start[:-1]).any():
        raise ConfigError(f"{damaged}: episode_start does not say where {count} episodes begin")
    return count, int(start[-1])


def _check_legs(about: dict[str, Any], arrays: dict[str, np.ndarray], damaged: str) -> None:
    """Check the shapes of the arrays that only legged robots have."""
    feet, contacts = len(about["feet"]), len(about["contacts"])
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("base_lin_vel", "base_ang_vel", "command"), (3,)),
        **dict.fromkeys(("feet_pos", "feet_force"), (feet, 3)),
        "ground": (),
        "feet_contact": (feet,),
        "contact_force": (contacts,),
    }
    for name, shape in shapes.items():
        if arrays[name].shape[1:] != shape:
            raise ConfigError(f"{damaged}: {name}: expected rows of shape {shape}, got {arrays[name].shape[1:]}")
    if arrays["qpos"].shape[1:] < (7,):
        raise ConfigError(f"{damaged}: qpos has no place for a floating base")
