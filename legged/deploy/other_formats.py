"""Contracts in other formats: the metadata that mjlab gives its ONNX files, and the deploy.yaml of Unitree's programs.

Neither format states limits, motors or the body of the IMU, so `Contract.fitted` takes them from the robot.
"""

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from legged.deploy.contract import COMMANDS, Contract, contract_of, need_of, refusing
from legged.deploy.errors import ConfigError, suggest
from legged.deploy.unitree import KINDS

DEPLOY = "deploy.yaml"
"""Name of Unitree's file. It lies beside the ONNX file, or in the folder params/ beside the ONNX file's folder."""
MJLAB_TERMS = {
    "base_lin_vel": "base_lin_vel",
    "base_ang_vel": "base_ang_vel",
    "projected_gravity": "projected_gravity",
    "command": "commands",
    "joint_pos": "dof_pos",
    "joint_vel": "dof_vel",
    "actions": "actions",
}
"""Observation term in mjlab's metadata -> our name."""
UNITREE_TERMS = {
    "base_ang_vel": "base_ang_vel",
    "projected_gravity": "projected_gravity",
    "velocity_commands": "commands",
    "joint_pos_rel": "dof_pos",
    "joint_vel_rel": "dof_vel",
    "last_action": "actions",
}
"""Observation term in deploy.yaml -> our name. Unitree's programs know no velocity of the base."""
RANGES = dict(zip(COMMANDS, ("lin_vel_x", "lin_vel_y", "ang_vel_z"), strict=True))
"""Command -> its name in deploy.yaml."""
JOINT_TERMS = ("dof_pos", "dof_vel", "actions")
MJLAB_DT = 0.02
"""Control step of mjlab's tasks, if the metadata lack `fps` [s]."""
CAUTIOUS = ((-0.5, 0.5), (-0.3, 0.3), (-0.5, 0.5))
"""Ranges of vx, vy [m/s] and yaw rate [rad/s], if the metadata lack `command_ranges`."""
NEVER = 100.0
"""Limits of at least this size are never reached, in SI units."""
UNLIMITED = 1e6
"""Clip of observations and actions, which these formats lack."""


def sdk_names(motors: int) -> tuple[str, ...] | None:
    """Return the joints of Unitree's robot with this number of motors, sorted by motor, or None."""
    kind = next((kind for kind in KINDS.values() if len(kind.motors) == motors), None)
    return None if kind is None else tuple(kind.facts.joint_names[i] for i in np.argsort(kind.motors))


def read_other(network: Path, metadata: Mapping[str, str]) -> Contract:
    """Return the contract of the ONNX file `network`, whose `metadata` are texts by name. A deploy.yaml has precedence.

    Raises:
        ConfigError: there is no contract, it is invalid, or this program cannot run its policy.
    """
    for path in (network.with_name(DEPLOY), network.parent.parent / "params" / DEPLOY):
        if path.is_file():
            with refusing(path, DEPLOY):
                return _unitree(path, _yaml(path))
    if "observation_names" in metadata:
        with refusing(network, "ONNX file with mjlab's metadata"):
            return _mjlab(network, metadata)
    raise ConfigError(
        f"POLICY: there is no {network.with_name('policy.json')}, no {DEPLOY}, and {network.name} has no metadata of mjlab"
    )


def _mjlab(path: Path, said: Mapping[str, str]) -> Contract:
    def numbers(key: str) -> list[Any]:
        rows = [[float(number) for number in text.split(";")] for text in said[key].split(",")]
        return [row[0] if len(row) == 1 else row for row in rows]

    if "anchor_body_name" in said:
        raise ConfigError(f"{path}: anchor_body_name: the policy tracks motions; a robot runs policies that follow commands")
    joints, names = ([name.strip() for name in said[key].split(",")] for key in ("joint_names", "observation_names"))
    columns = (numbers(f"observation_terms_{key}") for key in ("scale", "clip", "history_length", "flatten_history_dim"))
    terms = []
    for name, scale, clip, history, flat in zip(names, *columns, strict=True):
        if history > 1 and not flat:
            raise ConfigError(f"{path}: observation_terms_flatten_history_dim: must be 1 for '{name}'")
        terms.append(_term(f"{path}: observation_names", name, MJLAB_TERMS, scale, clip, history))
    scales, ranges = numbers("action_scale"), numbers("command_ranges") if "command_ranges" in said else CAUTIOUS
    said_here = {
        "default_joint_angles": numbers("default_joint_pos"),
        "stiffness": numbers("joint_stiffness"),
        "damping": numbers("joint_damping"),
        "action_scale": scales if len(scales) > 1 else scales[0],
        "control_dt": 1.0 / float(said["fps"]) if "fps" in said else MJLAB_DT,
        "command_ranges": dict(zip(COMMANDS, ranges, strict=True)),
    }
    return _contract(path, joints, terms, said_here)


def _unitree(path: Path, said: Mapping[str, Any]) -> Contract:
    count, places = len(said["stiffness"]), [int(i) for i in said["joint_ids_map"]]
    motors = sdk_names(count)
    if motors is None:
        known = ", ".join(f"{len(kind.motors)} ({name})" for name, kind in KINDS.items())
        raise ConfigError(f"{path}: stiffness: has {count} motors, but this program knows robots of {known}")
    if sorted(places) != list(range(count)):
        raise ConfigError(f"{path}: joint_ids_map: must name each of {count} motors once, got {places}")
    if list(said["actions"]) != ["JointPositionAction"]:
        raise ConfigError(f"{path}: actions: must be JointPositionAction alone, got {', '.join(said['actions'])}")
    action, default = said["actions"]["JointPositionAction"], said["default_joint_pos"]
    _check_clip(f"{path}: actions.JointPositionAction", action.get("clip"))
    if np.shape(default) != (count,) or not np.allclose(action.get("offset") or 0.0, default, rtol=0.0, atol=1e-6):
        raise ConfigError(f"{path}: actions.JointPositionAction.offset: must be default_joint_pos, {count} numbers")
    observed, ranges = dict(said["observations"]), said["commands"]["base_velocity"]["ranges"]
    by_frame = bool(observed.pop("use_gym_history", False))
    terms = []
    for name, entry in observed.items():
        given = (entry.get(key) for key in ("scale", "clip", "history_length"))
        terms.append(_term(f"{path}: observations", name, UNITREE_TERMS, *given))
    scale = action.get("scale")
    said_here = {
        "default_joint_angles": default,
        "stiffness": [said["stiffness"][i] for i in places],
        "damping": [said["damping"][i] for i in places],
        "action_scale": 1.0 if scale is None else scale,
        "control_dt": said["step_dt"],
        "command_ranges": {name: ranges[key] for name, key in RANGES.items()},
    }
    return _contract(path, [motors[i] for i in places], terms, said_here, by_frame)


def _term(where: str, name: str, terms: Mapping[str, str], scale: Any, clip: Any, history: Any) -> dict[str, Any]:
    """Return our name, the scale (a number or a list) and the number of observations of the term `name`."""
    if name not in terms:
        raise ConfigError(f"{where}: '{name}' cannot be observed here{suggest(name, terms)}")
    _check_clip(f"{where}: '{name}'", clip)
    return {"name": terms[name], "scale": 1.0 if scale is None else scale, "history": max(1, int(history or 1))}


def _check_clip(where: str, clip: Any) -> None:
    if clip is not None and not (np.abs(clip) >= NEVER).all():
        raise ConfigError(f"{where}: clip: this program clips only at {NEVER:g} and beyond, that is never; got {clip}")


def _contract(
    path: Path, joints: list[str], terms: list[dict[str, Any]], said: Mapping[str, Any], by_frame: bool = False
) -> Contract:
    """Return a contract that is not complete, with the entries `said` of policy.json. Each joint has an action. A history is
    a group of all terms if `by_frame`, and otherwise a group for each term.
    """
    groups: list[dict[str, Any]] = []
    observed, end = [], 0
    for term in terms:
        name, size, history = term["name"], len(joints) if term["name"] in JOINT_TERMS else 3, term["history"]
        if not (by_frame and groups):
            groups.append({"name": str(len(groups)), "start": end, "size": 0, "history": history})
        group = groups[-1]
        if group["history"] != history:
            raise ConfigError(f"{path}: observations.use_gym_history: needs one history_length, got several")
        scale = np.broadcast_to(term["scale"], size).tolist()
        shown = {"joints": joints} if name in ("dof_pos", "dof_vel") else {}
        start = group["start"] + group["size"]
        observed.append({**shown, "name": name, "group": group["name"], "start": start, "size": size, "scale": scale})
        observed[-1]["needs"] = need_of(name)
        group["size"] += size
        end = group["start"] + group["size"] * history
    nothing = [1.0] * len(joints)
    entries = {
        "task": path.name,
        "robot": "",
        "imu_frame": {"body": ""},
        "joint_names": joints,
        "action_joints": joints,
        "crouch_joint_angles": None,
        "position_limits": [None] * len(joints),
        "velocity_limits": nothing,
        "torque_limits": nothing,
        "action_clip": UNLIMITED,
        "observation_clip": UNLIMITED,
        "observation_groups": groups,
        "observation": observed,
        "command_dead_zone": 0.0,
        "recurrent": None,
    }
    return replace(contract_of(path, {**entries, **said}), complete=False)


def _yaml(path: Path) -> Any:
    """Return the contents of a YAML file. Only this format needs PyYAML, so it is imported here."""
    try:
        yaml = import_module("yaml")
    except ImportError as error:
        raise ConfigError(f"{path}: to read it, install PyYAML (pip install pyyaml)") from error
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(str(error)) from error
