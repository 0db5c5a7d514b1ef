"""What the engines are given of a robot's file: the file, if they can rely on it as it is, else what becomes of it."""

from functools import lru_cache
from pathlib import Path

import mujoco

from legged.errors import ConfigError
from legged.robots.importing.guess import read_robot
from legged.robots.importing.mend import mend
from legged.robots.importing.mjcf import drop_what_is_drawn
from legged.robots.importing.shapes import fit_meshes, name_shapes
from legged.robots.importing.text import mjcf_of

URDF = ".urdf"


def robot_spec_of(path: Path, drawn: bool = False) -> mujoco.MjSpec:
    """Return a robot's model. A URDF, and MJCF that was written for something else, are adapted: what a scene has beside the
    robot goes, the base floats, welded links are merged, hinges that are driven have motors, in their order, and each shape
    that collides has a name and is a primitive. Shapes that are only seen are left out of those unless `drawn`.

    Raises:
        ConfigError: there is no robot in the file.
        Exception: MuJoCo refuses it; its errors have no class of their own.
    """
    if path.suffix.lower() != URDF:
        spec = mujoco.MjSpec.from_file(str(path))
        if is_plain(spec):
            if not drawn:
                drop_what_is_drawn(spec, path)
            return spec
    return mujoco.MjSpec.from_string(_adapted(path, _stamp(path), drawn)[0])


def adaptations(path: Path) -> tuple[str, ...]:
    """Return what was done to a robot's file so that engines can rely on it, a line each; none for one that is used as it is.
    Raises as `robot_spec_of`.
    """
    return () if is_plain_file(path) else _adapted(path, _stamp(path), False)[1]


def _stamp(path: Path) -> tuple[int, int]:
    """Return what tells the states of a file apart."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size


@lru_cache(maxsize=16)
def _adapted(path: Path, _stamp: tuple[int, int], drawn: bool) -> tuple[str, tuple[str, ...]]:
    """Return the MJCF of a file that is adapted, and what was done to it, once for each state of it."""
    tree = read_robot(path, drawn=drawn)
    bare = not tree.shapes
    if bare and not drawn:  # what is drawn will collide
        tree = read_robot(path)
    fit_meshes(tree)
    if bare and not drawn:
        for link in tree.links:
            link.shapes = [shape for shape in link.shapes if shape.collides]
    mend(tree)
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
    """Return whether a robot's file is used as it is."""
    return path.suffix.lower() != URDF and is_plain(mujoco.MjSpec.from_file(str(path)))


def is_plain(spec: mujoco.MjSpec) -> bool:
    """Return whether a spec is a robot alone, as engines rely on it: one body with a free joint on the world, named joints
    below it, motors of hinges in their order, and shapes that collide with names, none of them a mesh.
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
    """Return whether an actuator passes on a torque as it is."""
    return (
        actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
        and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and actuator.gainprm[0] == 1.0
        and list(actuator.gear) == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    )
