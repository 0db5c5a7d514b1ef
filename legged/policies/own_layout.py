"""The layout of a policy that this package exported: its policy.json, as `policies.foreign` wants it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from legged.config.actuator import ActuatorConfig
from legged.config.checks import build
from legged.config.origins import Origins
from legged.errors import ConfigError
from legged.mdp.actuator import is_ideal

COMMANDS = ("command_xy", "command_yaw")
"""What layouts call our term `commands`: its first two columns, and its third."""


def read_description(path: Path) -> dict[str, Any]:
    """Return the entries of a layout that say the same as the policy.json at `path`.

    Raises:
        ConfigError: it is none, or of a policy that a layout cannot describe: one with a memory, of another control law, or
            with columns of one term that have scales of their own.
    """
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: is no policy.json of an export ({' '.join(str(error).split())})") from error
    try:
        return _entries(said, path)
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ConfigError(f"{path}: is no policy.json of an export ({type(error).__name__}: {error})") from error


def was_trained_with_other_motors(path: Path) -> bool:
    """Return whether the policy of the policy.json at `path`, which `read_description` has read, had motors in its training
    that no layout describes: control.actuator with a torque-speed line, friction, a delay, a learned law or rotors.

    Raises:
        ConfigError: what it says of motors is nothing that there is.
    """
    said = json.loads(path.read_text(encoding="utf-8")).get("actuator", {})
    motors = build(ActuatorConfig, said, "", Origins(), f"{path}: actuator")
    return not is_ideal(motors) or bool(motors.armature)


def _entries(said: Mapping[str, Any], path: Path) -> dict[str, Any]:
    if said["recurrent"] is not None or any(group["history"] != 1 for group in said["observation_groups"]):
        raise ConfigError(f"{path}: the policy has a memory; only policies that see one observation can be played here")
    if said["control_type"] != "P":
        raise ConfigError(f"{path}: control_type: got {said['control_type']!r}; only 'P' can be played here")
    joints, acted, scale = said["joint_names"], said["action_joints"], said["action_scale"]

    def by_joint(key: str) -> dict[str, float]:
        return dict(zip(joints, said[key], strict=True))

    return {
        "observation": _observation(said["observation"], path),
        "observation_clip": said["observation_clip"],
        "joints": joints,
        "action_joints": acted,
        "action_scale": dict(zip(acted, scale, strict=True)) if isinstance(scale, list) else scale,
        "action_clip": said["action_clip"],
        "default_joint_angles": by_joint("default_joint_angles"),
        "stiffness": by_joint("stiffness"),
        "damping": by_joint("damping"),
        "torque_limits": by_joint("torque_limits"),
        "control_dt": said["control_dt"],
        "sim_dt": said["sim_dt"],
    }


def _observation(terms: list[Any], path: Path) -> dict[str, float]:
    """Return term -> scale in the order of the columns."""
    found: dict[str, float] = {}
    for term in terms:
        scales = term["scale"]
        name = term["name"]
        parts = dict(zip(COMMANDS, (scales[:2], scales[2:]), strict=True)) if name == "commands" else {name: scales}
        for part, values in parts.items():
            if any(value != values[0] for value in values):
                raise ConfigError(f"{path}: observation: columns of '{name}' have scales of their own: {scales}")
            found[part] = values[0]
    return found
