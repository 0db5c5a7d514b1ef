"""Files of motions: csv (root position, root quaternion with w last, joint angles), npz of mjlab and of holosoma, and ONNX
trackers that hold their motion.
"""

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from legged.errors import ConfigError, suggest
from legged.motion.clip import Clip, make_clip
from legged.motion.kinematics import Skeleton
from legged.process.paths import data_folder, exists, relative

ROOT = 7
"""Columns of the root: position and quaternion."""
READERS = (".csv", ".npz", ".onnx")
"""Endings of the files that can be read."""
CSV_FPS, ONNX_FPS = 30.0, 50.0
"""Frames per second of csv files and of ONNX files that do not say. Those of csv files may be given."""


def read_clip(path: Path, skeleton: Skeleton, csv_fps: float = CSV_FPS) -> Clip:
    """Read a motion of a robot. Bodies are left out: `Skeleton` computes them from root and joints, because their frames
    differ between models of one robot.

    Raises:
        ConfigError: the file can't be read, or does not fit the robot.
    """
    where = relative(path)
    if path.suffix not in READERS:
        raise ConfigError(f"{where}: motions are read from {', '.join(READERS)}")
    try:
        if path.suffix == ".csv":
            return _read_csv(path, skeleton, where, csv_fps)
        return _read_npz(path, skeleton, where) if path.suffix == ".npz" else _read_onnx(path, skeleton, where)
    except (OSError, ValueError, TypeError, IndexError, EOFError, BadZipFile, zlib.error) as error:
        raise ConfigError(f"{where}: can't be read as a motion ({error})") from error


def motion_files(names: Sequence[str], where: str) -> list[Path]:
    """Return the files of motions among `names`, and those in the folders among them. A relative path is relative to
    resources/motions. Error messages begin with `where`.

    Raises:
        ConfigError: there is no motion, or a path is neither a file nor a folder with one.
    """
    files: list[Path] = []
    for path in (data_folder("resources") / "motions" / name for name in names):
        is_folder = exists(path) and path.is_dir()
        found = sorted(file for file in path.rglob("*") if file.suffix in READERS) if is_folder else [path]
        if not found or not exists(found[0]):
            raise ConfigError(
                f"{where}: {relative(path)} is no file of a motion, and no folder with one ({', '.join(READERS)})"
            )
        files += found
    if not files:
        raise ConfigError(f"{where}: name at least one file of a motion ({', '.join(READERS)})")
    return list(dict.fromkeys(files))


def _read_csv(path: Path, skeleton: Skeleton, where: str, fps: float) -> Clip:
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    _check_width(rows, ROOT + len(skeleton.robot.joint_names), where)
    return make_clip(path.stem, fps, rows[:, :3], rows[:, [6, 3, 4, 5]], rows[:, ROOT:], where)


def _read_npz(path: Path, skeleton: Skeleton, where: str) -> Clip:
    with np.load(path) as file:
        arrays = dict(file)
    if "joint_pos" not in arrays:
        raise ConfigError(f"{where}: has no array 'joint_pos'{suggest('joint_pos', arrays, 'arrays')}")
    if "fps" not in arrays:
        raise ConfigError(f"{where}: has no array 'fps', the frames per second{suggest('fps', arrays, 'arrays')}")
    rows, names = arrays["joint_pos"], _texts(arrays.get("joint_names"))
    count = len(skeleton.robot.joint_names) if names is None else len(names)
    fps = float(np.ravel(arrays["fps"])[0])
    if rows.ndim == 2 and rows.shape[1] == ROOT + count and names is not None:
        pos, quat, joint = rows[:, :3], rows[:, 3:ROOT], rows[:, ROOT:]
    else:
        _check_width(rows, count, where)
        bodies = _texts(arrays.get("body_names"))
        pos, quat = _pose_of(skeleton.robot.file.base, arrays, bodies, skeleton, where)
        joint = rows
    return make_clip(path.stem, fps, pos, quat, _ordered(joint, names, skeleton, where), where)


def _read_onnx(path: Path, skeleton: Skeleton, where: str) -> Clip:
    import onnx  # only needed here, and slow to import, as onnxruntime is

    from legged.deploy.policy import listed

    try:
        graph = onnx.load(str(path))
    except Exception as error:  # protobuf's errors have no common class
        raise ConfigError(f"{where}: onnx can't read it: {' '.join(str(error).split())[:200]}") from error
    arrays = _tables(graph.graph)
    if "joint_pos" not in arrays:
        raise ConfigError(f"{where}: the model has no output 'joint_pos' that is looked up by time step; it holds no motion")
    said = {entry.key: entry.value for entry in graph.metadata_props}
    names = listed(path, said, ("joint_names", "dof_names"))
    joint = _ordered(arrays["joint_pos"], names, skeleton, where)
    if "ref_pos_xyz" in arrays:  # holosoma: the pose of the torso
        quat = arrays["ref_quat_xyzw"][:, [3, 0, 1, 2]].astype(np.float64)
        pos, quat = skeleton.root_poses("torso_link", arrays["ref_pos_xyz"].astype(np.float64), quat, joint)
    else:
        bodies, base = listed(path, said, ("body_names",)), skeleton.robot.file.base
        anchor = said.get("anchor_body_name", base)
        body = anchor if bodies is not None and base not in bodies and anchor in bodies else base
        pos, quat = _pose_of(body, arrays, bodies, skeleton, where)
        if body != base:
            pos, quat = skeleton.root_poses(body, pos.astype(np.float64), quat.astype(np.float64), joint)
    return make_clip(path.stem, float(said.get("fps", ONNX_FPS)), pos, quat, joint, where)


def _tables(graph: Any) -> dict[str, np.ndarray]:
    """Return for each output of an ONNX graph the table (T, ...) that it is gathered from, if it is."""
    from onnx import numpy_helper

    values = {tensor.name: tensor for tensor in graph.initializer}
    makers = {output: node for node in graph.node for output in node.output}
    values |= {
        node.output[0]: attribute.t
        for node in graph.node
        if node.op_type == "Constant"
        for attribute in node.attribute
        if attribute.name == "value"
    }
    found = {}
    for output in graph.output:
        node = makers.get(output.name)
        while node is not None and node.op_type in ("Identity", "Cast", "Unsqueeze", "Squeeze", "Reshape"):
            node = makers.get(node.input[0])
        if node is not None and node.op_type == "Gather" and node.input[0] in values:
            found[output.name] = numpy_helper.to_array(values[node.input[0]])
    return found


def _pose_of(
    body: str, arrays: Mapping[str, np.ndarray], bodies: Sequence[str] | None, skeleton: Skeleton, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return a body's positions (T, 3) and quaternions (T, 4), from `body_pos_w` (T, B, 3) and `body_quat_w` (T, B, 4). If
    the `bodies` have no names, the first is the base.
    """
    for name in ("body_pos_w", "body_quat_w"):
        if name not in arrays:
            raise ConfigError(f"{where}: holds no root pose: there is no '{name}'{suggest(name, arrays, 'arrays')}")
    if bodies is not None and body not in bodies:
        raise ConfigError(
            f"{where}: has no body '{body}', the base of {skeleton.robot.name}{suggest(body, bodies, 'bodies')}"
        )
    index = 0 if bodies is None else list(bodies).index(body)
    return arrays["body_pos_w"][:, index], arrays["body_quat_w"][:, index]


def _ordered(joint: np.ndarray, names: Sequence[str] | None, skeleton: Skeleton, where: str) -> np.ndarray:
    """Return joint angles (T, D) in the order of the robot's model. Without `names`, the file has this order."""
    own = skeleton.robot.joint_names
    if names is None:
        _check_width(joint, len(own), where)
        return joint
    _check_width(joint, len(names), where)
    for name in own:
        if name not in names:
            raise ConfigError(f"{where}: has no joint '{name}' of {skeleton.robot.name}{suggest(name, names, 'joints')}")
    return joint[:, [list(names).index(name) for name in own]]


def _check_width(rows: np.ndarray, width: int, where: str) -> None:
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ConfigError(f"{where}: expected rows of {width} numbers, got the shape {rows.shape}")


def _texts(names: np.ndarray | None) -> list[str] | None:
    return None if names is None else [str(name) for name in names.tolist()]
