"""Robot settings of a legged_gym configuration -> control tables of a task, and entries of robot.yaml."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged.migration.translation import Translation
from legged.robots.robot import Robot

FOOT, PENALISED, ENDING = "asset.foot_name", "asset.penalize_contacts_on", "asset.terminate_after_contacts_on"
POSE, POSITION, ROTATION = "init_state.default_joint_angles", "init_state.pos", "init_state.rot"


def asset_of(result: Translation) -> str:
    """Return the path of the robot's file in a configuration, without legged_gym's folder."""
    file = str(result.get("asset.file", "") or "")
    return file.replace("{LEGGED_GYM_ROOT_DIR}/", "").replace("{LEGGED_GYM_ROOT_DIR}", "")


def names_of(result: Translation) -> list[str]:
    """Return possible names of the robot here: the actor's name, the file's, and the folder's above the file."""
    path = Path(asset_of(result))
    folders = [part for part in path.parts[:-1] if part not in ("resources", "robots", "urdf", "xml", "mjcf", "..", ".")]
    return [name for name in (str(result.get("asset.name", "")), path.stem, *folders[::-1]) if name]


def map_robot(result: Translation, robot: Robot | None) -> dict[str, Any]:
    """Set the task's gains, and return entries of robot.yaml: those that differ from the entries of `robot`, or all without
    one.
    """
    entries: dict[str, Any] = {}
    if robot is None:
        _without_robot(result, entries)
        return entries
    _gains(result, robot)
    _pose(result, robot, entries)
    _contacts(result, robot, entries)
    return entries


def _has_network(result: Translation) -> bool:
    """Return True if torques come from an actuator network, so that gains have no meaning."""
    return bool(result.get("control.use_actuator_network", False))


def _without_robot(result: Translation, entries: dict[str, Any]) -> None:
    """Fill the entries for a robot that does not exist here yet."""
    for name in ("stiffness", "damping"):
        table = result.table(f"control.{name}")
        if table and not _has_network(result):
            result.put(f"control.{name}", table, f"control.{name}")
    position, pose = result.numbers(POSITION, []), result.table(POSE)
    if len(position) == 3:
        entries["spawn_height"] = float(position[2])
    if pose:
        entries["default_joint_angles"] = pose
    for theirs, ours in ((FOOT, "feet"), (PENALISED, "penalize_contacts_on"), (ENDING, "terminate_after_contacts_on")):
        patterns = _patterns(result, theirs)
        if patterns:
            entries[ours] = patterns


def _patterns(result: Translation, path: str) -> list[str]:
    """Return a list of name patterns; a fork may give a single one as text."""
    value = result.get(path)
    found = [value] if isinstance(value, str) else [str(item) for item in value] if isinstance(value, list | tuple) else []
    return [name for name in found if name and name != "None"]


def _gains(result: Translation, robot: Robot) -> None:
    """Set the task's gains where they differ from the robot's, one value per joint by legged_gym's rule."""
    if _has_network(result):
        return
    for name in ("stiffness", "damping"):
        path = f"control.{name}"
        table = result.table(path)
        if not table:
            continue
        for pattern in [key for key in table if not any(key in joint for joint in robot.joint_names)]:
            del table[pattern]
            result.lose(path, f"'{pattern}' is part of no joint of {robot.name}")
        wanted = {joint: _last_match(table, joint) for joint in robot.joint_names}
        bare = [joint for joint, value in wanted.items() if value is None]
        if bare:
            result.lose(path, f"says nothing of {', '.join(bare)}; legged_gym gives such joints none")
        numbers = [value or 0.0 for value in wanted.values()]
        own = robot.gains(getattr(robot.file, name), name)
        if np.allclose(numbers, own):
            continue
        exact = not bare and np.allclose(numbers, robot.gains(table, name))
        by_joint = dict(zip(robot.joint_names, numbers, strict=True))
        result.put(path, table if exact else by_joint, path, f"{robot.name} has {_few(own)}")


def _last_match(table: dict[str, float], joint: str) -> float | None:
    """Return the value of the last pattern that is part of a joint's name, because legged_gym tries all in order."""
    found = None
    for pattern, value in table.items():
        if pattern in joint:
            found = value
    return found


def _few(values: np.ndarray) -> str:
    numbers = list(dict.fromkeys(f"{value:g}" for value in values))
    return ", ".join(numbers[:4]) + (", ..." if len(numbers) > 4 else "")


def _pose(result: Translation, robot: Robot, entries: dict[str, Any]) -> None:
    pose = result.table(POSE)
    unknown = [name for name in pose if name not in robot.joint_names]
    if unknown:
        result.lose(POSE, f"{robot.name} has no {', '.join(unknown)} (joints: {', '.join(robot.joint_names)})")
    angles = {joint: float(pose.get(joint, own)) for joint, own in zip(robot.joint_names, robot.default_dof_pos, strict=True)}
    if not np.allclose(list(angles.values()), robot.default_dof_pos, atol=1e-6):
        entries["default_joint_angles"] = angles
    position = result.numbers(POSITION, [])
    if len(position) == 3:
        if abs(position[2] - robot.file.spawn_height) > 1e-6:
            entries["spawn_height"] = float(position[2])
        if any(position[:2]):
            result.lose(POSITION, "robots start on their tiles' middles here; the height alone is taken")
    rotation = result.numbers(ROTATION, [0, 0, 0, 1])
    if rotation != [0, 0, 0, 1]:
        result.lose(ROTATION, "robots start level here, with a heading in init_state.yaw")


def _contacts(result: Translation, robot: Robot, entries: dict[str, Any]) -> None:
    """Find the shapes of the bodies in the contact lists."""
    bodies = _bodies_of_shapes(robot)
    for theirs, ours, indices in (
        (FOOT, "feet", robot.feet_indices),
        (PENALISED, "penalize_contacts_on", robot.penalised_indices),
        (ENDING, "terminate_after_contacts_on", robot.termination_indices),
    ):
        patterns = _patterns(result, theirs)
        if theirs not in result.theirs or (not patterns and ours == "feet"):
            continue
        wanted: list[str] = []
        found: set[int] = set()
        for pattern in patterns:
            named = [i for i, name in enumerate(robot.contact_names) if pattern in name]
            shapes = [i for i, body in enumerate(bodies) if pattern in body]
            if ours != "feet":  # the shape of a foot on a shank does not belong to the shank
                shapes = [i for i in shapes if i not in robot.feet_indices]
            if not shapes and not named:
                result.lose(theirs, f"'{pattern}' is part of no body or shape of {robot.name} that collides")
                continue
            chosen = named or shapes
            found |= set(chosen)
            wanted += [pattern] if chosen == named else [robot.contact_names[i] for i in chosen]
        if ours == "feet" and found and len(found) != len({bodies[i] for i in found}):
            result.lose(theirs, f"bodies of {robot.name} with that name have several shapes; its own feet are kept")
            continue
        if tuple(sorted(found)) != tuple(indices) and (found or not patterns):
            entries[ours] = list(dict.fromkeys(wanted))


def _bodies_of_shapes(robot: Robot) -> Sequence[str]:
    """Return the body of each collision shape."""
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    return [model.body(int(model.geom(name).bodyid[0])).name for name in robot.contact_names]
