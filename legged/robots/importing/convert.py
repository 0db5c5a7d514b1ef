"""Conversion of a robot's file to the model that the engines take: the file unchanged if it meets their conditions, else an
adapted copy.
"""

from functools import lru_cache
from pathlib import Path

import mujoco

from legged.errors import ConfigError
from legged.robots.importing.infer import read_robot
from legged.robots.importing.mjcf import drop_visual_meshes
from legged.robots.importing.mjcf_source import read_spec
from legged.robots.importing.mjcf_writer import mjcf_of
from legged.robots.importing.repair import repair
from legged.robots.importing.shapes import count_fitted, fit_meshes, name_shapes
from legged.robots.importing.wheels import find_wheels

URDF = ".urdf"


def robot_spec_of(path: Path, drawn: bool = False) -> mujoco.MjSpec:
    """Return the MuJoCo spec of a robot.

    A URDF, and MJCF that was written for another use, are adapted: everything in a scene except the robot is removed, the
    base floats, welded links are merged, driven hinges have motors in the order of the hinges, and each collision shape is a
    primitive with a name. The adapted model has visual shapes only if `drawn`.

    Raises:
        ConfigError: there is no robot in the file.
        Exception: MuJoCo refuses the file; its errors have no class of their own.
    """
    if path.suffix.lower() != URDF:
        spec, _ = read_spec(path)
        if is_plain(spec):
            if not drawn:
                drop_visual_meshes(spec, path)
            return spec
    return mujoco.MjSpec.from_string(_adapted(path, _stamp(path), drawn)[0])


def adaptations(path: Path) -> tuple[str, ...]:
    """Return one line for each change that was made to a robot's file for the engines; empty if the file is used unchanged.
    Raises as `robot_spec_of`.
    """
    return () if is_plain_file(path) else _adapted(path, _stamp(path), False)[1]


def _stamp(path: Path) -> tuple[int, int]:
    """Return the time of a file's last change and its size. Together they identify the state of the file."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size


@lru_cache(maxsize=16)
def _adapted(path: Path, _stamp: tuple[int, int], drawn: bool) -> tuple[str, tuple[str, ...]]:
    """Return the MJCF of an adapted file, and one line for each change. `_stamp` renews the cache entry of a changed file."""
    tree = read_robot(path, drawn=drawn)
    bare = not tree.shapes
    if bare and not drawn:  # without collision shapes, read the visual shapes, because copies of them will collide
        tree = read_robot(path)
    fit_meshes(tree)
    if bare and not drawn:
        for link in tree.links:
            link.shapes = [shape for shape in link.shapes if shape.collides]
    repair(tree)
    find_wheels(tree)
    count_fitted(tree)
    name_shapes(tree)
    files: dict[str, Path] = {}
    for i, shape in enumerate(shape for link in tree.links for shape in link.shapes if not shape.collides):
        if shape.mesh is not None and shape.mesh.file is not None:
            shape.mesh.name = f"mesh_{i}"
            files[shape.mesh.name] = shape.mesh.file
    try:
        return mjcf_of(tree, files), tuple(tree.said)
    except (ValueError, ArithmeticError) as error:
        raise ConfigError(f"{path}: can't be adapted: {error}") from error


def is_plain_file(path: Path) -> bool:
    """Return True if a robot's file is used unchanged."""
    return path.suffix.lower() != URDF and is_plain(read_spec(path)[0])


def is_plain(spec: mujoco.MjSpec) -> bool:
    """Return True if a spec holds only a robot that meets the engines' conditions: one body with a free joint on the world,
    named joints below it, motors of hinges in the order of the hinges, and named collision shapes without meshes.
    """
    world = spec.worldbody
    if len(world.bodies) != 1 or world.geoms:
        return False
    joints = list(spec.joints)
    hinges = [joint for joint in joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
    if not hinges or len(world.bodies[0].joints) != 1 or world.bodies[0].joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
        return False
    below = [joint for joint in joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    if len(joints) != len(below) + 1 or not all(joint.name for joint in below):
        return False
    order = [joint.name for joint in hinges]
    driven = [actuator.target for actuator in spec.actuators if _is_motor(actuator)]
    if len(driven) < len(spec.actuators) or not driven or driven != [name for name in order if name in driven]:
        return False
    touched = [geom for geom in spec.geoms if geom.contype or geom.conaffinity]
    return all(geom.name and geom.type != mujoco.mjtGeom.mjGEOM_MESH and not geom.meshname for geom in touched)


def _is_motor(actuator: mujoco.MjsActuator) -> bool:
    """Return True if an actuator applies its control as a torque."""
    return (
        actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
        and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and actuator.gainprm[0] == 1.0
        and list(actuator.gear) == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    )
