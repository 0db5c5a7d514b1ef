"""Geometry of a robot in its default pose: its height, and the joints that swing its legs forward."""

from collections.abc import Sequence

import mujoco
import numpy as np

ALONG = 0.7
"""A joint swings a leg forward if |y| of its unit axis (base frame) exceeds this. The axis is then within 45 degrees of y."""


def stance(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    """Return MuJoCo's data with the poses of all bodies at the generalised positions `qpos` (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return the height of the lowest point of a shape, world frame [m]."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    down = data.geom_xmat[geom].reshape(3, 3)[2]  # the world's vertical axis in the shape's frame
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_SPHERE:
        below = size[0]
    elif kind == types.mjGEOM_CAPSULE:
        below = size[0] + abs(down[2]) * size[1]
    elif kind == types.mjGEOM_CYLINDER:
        below = np.hypot(down[0], down[1]) * size[0] + abs(down[2]) * size[1]
    elif kind == types.mjGEOM_ELLIPSOID:
        below = np.linalg.norm(down * size)
    elif kind == types.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        below = -float((model.mesh_vert[first : first + count] @ down).min())
    else:  # a box, or the bounding box of another shape
        below = np.abs(down) @ size
    return float(data.geom_xpos[geom, 2] - below)


def standing_height(model: mujoco.MjModel, base: str, qpos: np.ndarray) -> float:
    """Return the height [m] of a level base above the lowest point of all collision shapes at `qpos` (nq,)."""
    data = stance(model, qpos)
    shapes = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    return float(data.body(base).xpos[2] - min(lowest_point(model, data, int(i)) for i in shapes))


def swinging_joints(model: mujoco.MjModel, qpos: np.ndarray, joints: Sequence[int], feet: Sequence[int]) -> np.ndarray:
    """Return (D,) True for each hinge of `joints` (ids) that swings a leg forward and back, as hip, knee and ankle do.

    Such a hinge lies between the base and one of the shapes `feet` (ids), and its axis points sideways in the pose
    `qpos`, in which the base is level.
    """
    data = stance(model, qpos)
    on_leg = set()
    for foot in feet:
        body = model.geom_bodyid[foot]
        while body:
            on_leg.add(int(body))
            body = model.body_parentid[body]
    sideways = np.abs(data.xaxis[list(joints), 1]) > ALONG
    return sideways & np.array([int(model.jnt_bodyid[i]) in on_leg for i in joints])
