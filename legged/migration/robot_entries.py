"""Mapping of a fork's robot settings to control tables of a task and to entries of robot.yaml."""

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.migration.translation import Translation
from legged.robots.robot import Robot
from legged.robots.shapes import Shapes, match_shapes

POSE, POSITION, ROTATION = "init_state.default_joint_angles", "init_state.pos", "init_state.rot"
MOST_NAMES = 12
"""Largest number of joints whose names are shown."""
LISTS = (
    ("asset.foot_name", "feet"),
    ("asset.penalize_contacts_on", "penalize_contacts_on"),
    ("asset.terminate_after_contacts_on", "terminate_after_contacts_on"),
)


def asset_of(result: Translation) -> str:
    """Return the path of the robot's file in a configuration, without {LEGGED_GYM_ROOT_DIR} or the like at its beginning."""
    return re.sub(r"^\{\w+\}/*", "", str(result.get("asset.file", "") or ""))


def names_of(result: Translation) -> list[str]:
    """Return possible names of the robot in this package: the asset's name, and the names of its file and of the folders
    above the file.
    """
    path = Path(asset_of(result))
    folders = [part for part in path.parts[:-1] if part not in ("resources", "robots", "urdf", "xml", "mjcf", "..", ".", "/")]
    return [name for name in (str(result.get("asset.name", "")), path.stem, *folders[::-1]) if name]


def map_robot(result: Translation, robot: Robot | None) -> dict[str, Any]:
    """Translate the fork's settings of the robot. Write the gains to `result`. Return the other settings as
    entries of a robot.yaml: all of them if `robot` is None, otherwise only those that differ from `robot`.
    """
    gains = {name: result.get(f"control.{name}", {}) for name in ("stiffness", "damping")}
    if result.get("control.use_actuator_network", False) or result.get("control.control_type") == "actuator_net":
        gains = {}  # a network computes the torques
    entries: dict[str, Any] = {}
    patterns = {ours: _patterns(result, theirs) for theirs, ours in LISTS}
    position, pose = result.get(POSITION, []), result.get(POSE, {})
    if result.get(ROTATION, [0, 0, 0, 1]) != [0, 0, 0, 1]:
        result.lose(ROTATION, "robots start level here, with a heading in init_state.yaw")
    if len(position) == 3:
        if robot is None or abs(position[2] - robot.file.spawn_height) >= 1e-6:
            entries["spawn_height"] = float(position[2])
        if any(position[:2]):
            result.lose(POSITION, "robots start in the middle of their tiles here, so only the height is taken")
    for name, table in gains.items():
        if robot is not None:
            _gains(result, robot, name, table)
        elif table:
            result.put(f"control.{name}", table, f"control.{name}")
    if robot is None:
        return entries | {name: value for name, value in {"default_joint_angles": pose, **patterns}.items() if value}
    unknown = [name for name in pose if name not in robot.joint_names]
    if unknown:
        result.lose(POSE, f"{robot.name} has no {', '.join(unknown)} (joints: {', '.join(robot.joint_names)})")
    angles = {joint: float(pose.get(joint, own)) for joint, own in zip(robot.joint_names, robot.default_dof_pos, strict=True)}
    if not np.allclose(list(angles.values()), robot.default_dof_pos, atol=1e-6):
        entries["default_joint_angles"] = angles
    shapes = Shapes.of(mujoco.MjModel.from_xml_path(str(robot.model_path)), robot.file.feet, "feet")
    of_robot = (robot.feet_indices, robot.penalised_indices, robot.termination_indices)
    for (theirs, ours), own in zip(LISTS, of_robot, strict=True):
        if theirs in result.theirs and (patterns[ours] or ours != "feet"):
            kept, found = _contacts(result, theirs, patterns[ours], shapes, robot.name)
            if tuple(sorted(found)) != tuple(own) and (found or not patterns[ours]):
                entries[ours] = list(dict.fromkeys(kept))
    count, few = result.get("env.num_actions"), ", ".join(robot.joint_names[:MOST_NAMES])
    other = f"; the fork has {count} actions" if count not in (None, robot.num_dof) else ""
    order = f"in the order {few}{', ...' if robot.num_dof > MOST_NAMES else ''}"
    text = f"{robot.name} has {robot.num_dof} joints {order}{other}; Isaac Gym's order may differ: index them by name"
    armature, rotors = result.get("asset.armature", 0.0), robot.armature
    if not np.allclose(rotors, armature):
        text += f"; its rotor inertias are {min(rotors):g} to {max(rotors):g} kg m^2, those of the fork {armature:g}"
    result.note("robot", text)
    return entries


def _patterns(result: Translation, path: str) -> list[str]:
    """Return a list of name patterns. A fork may give a single pattern as text."""
    value = result.get(path)
    names = value if isinstance(value, list) else [value] if isinstance(value, str) else []
    return [str(name) for name in names if name and name != "None"]


def _gains(result: Translation, robot: Robot, name: str, table: dict[str, float]) -> None:
    """Set the task's gains where they differ from the robot's. If several patterns are part of a joint's name, the last one
    counts, as in legged_gym.
    """
    path, own = f"control.{name}", getattr(robot, name)
    for pattern in [key for key in table if not any(key in joint for joint in robot.joint_names)]:
        del table[pattern]
        result.lose(path, f"'{pattern}' is part of no joint of {robot.name}")
    if not table:
        return
    wanted = {joint: [v for pattern, v in table.items() if pattern in joint] for joint in robot.joint_names}
    bare = [joint for joint, values in wanted.items() if not values]
    if bare:
        result.lose(path, f"has no value for {', '.join(bare)}; legged_gym then uses 0")
    numbers = [values[-1] if values else 0.0 for values in wanted.values()]
    if not np.allclose(numbers, own):
        exact = not bare and np.allclose(numbers, robot.each(table, name))
        by_joint = dict(zip(robot.joint_names, numbers, strict=True))
        few = ", ".join(list(dict.fromkeys(f"{value:g}" for value in own))[:4])
        result.put(path, table if exact else by_joint, path, f"{robot.name} has {few}")


def _contacts(
    result: Translation, theirs: str, patterns: list[str], shapes: Shapes, robot: str
) -> tuple[list[str], set[int]]:
    """Return the patterns that match, and the indices of the matched shapes. Names of shapes replace a pattern that would
    wrongly match feet.
    """
    found: set[int] = set()
    kept: list[str] = []
    for pattern in patterns:
        try:
            indices = match_shapes([pattern], shapes.names, shapes.bodies, "")
        except ConfigError:
            result.lose(theirs, f"'{pattern}' is part of no body or shape of {robot} that collides")
            continue
        # Outside the list of feet, a pattern in no shape's name does not select feet: 'shank' must not select a foot on it.
        named = theirs == LISTS[0][0] or any(pattern in name for name in shapes.names)
        chosen = [i for i in indices if named or shapes.contact[i] not in shapes.feet]
        kept += [pattern] if len(chosen) == len(indices) else [shapes.names[i] for i in chosen]
        found |= {shapes.contact[i] for i in chosen}
    return kept, found
