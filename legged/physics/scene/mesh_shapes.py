"""Meshes that touch, as the simple shapes that come nearest to them, for colliders that know no meshes."""

from collections.abc import Iterator

import mujoco
import numpy as np

KINDS = mujoco.mjtGeom


def fit_meshes(spec: mujoco.MjSpec) -> str:
    """Put simple shapes in place of the meshes of `spec` that collide, and return which, in words; empty if there are none.

    MuJoCo fits a box to a mesh's bounds (compiler option `fitaabb`). Of it and of the sphere, capsule and cylinder of these
    bounds, as MuJoCo would size them, that one is taken from which the surface of the mesh's convex hull is least far on
    average. Masses and inertias stay as they are.
    """
    meshes = [geom for geom in spec.geoms if geom.type == KINDS.mjGEOM_MESH and (geom.contype or geom.conaffinity)]
    if not meshes:
        return ""
    model, boxed = spec.compile(), spec.copy()
    boxed.compiler.fitaabb = True
    for geom in meshes:
        boxed.geom(geom.name).type = KINDS.mjGEOM_BOX
    boxes = boxed.compile()
    words = []
    for geom in meshes:
        box = boxes.geom(geom.name)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, box.quat)
        hull = (_hull(model, geom.name) - box.pos) @ turn.reshape(3, 3)
        miss, (kind, size) = min(((_miss(hull, *shape), shape) for shape in _of_bounds(box.size)), key=lambda pair: pair[0])
        geom.type, geom.meshname, geom.size = kind, "", size
        geom.pos, geom.quat, geom.alt.type = box.pos, box.quat, mujoco.mjtOrientation.mjORIENTATION_QUAT
        words.append(f"{geom.name} by a {kind.name.removeprefix('mjGEOM_').lower()} ({1000.0 * miss:.0f} mm)")
    for body in spec.bodies[1:]:
        _keep_inertia(body, model)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    return ", ".join(words)


def _of_bounds(half: np.ndarray) -> Iterator[tuple[mujoco.mjtGeom, tuple[float, ...]]]:
    """Yield simple shapes, by their kinds and sizes, for bounds of half extents `half` [m]."""
    wide, long = max(half[:2]), half[2]
    yield KINDS.mjGEOM_BOX, tuple(half)
    yield KINDS.mjGEOM_SPHERE, (max(half), 0.0, 0.0)
    yield KINDS.mjGEOM_CYLINDER, (wide, long, 0.0)
    if long > wide:
        yield KINDS.mjGEOM_CAPSULE, (wide, long - wide, 0.0)


def _hull(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the triangles (F, 3, 3) of the convex hull with which a geom's mesh collides, in the frame of its body [m]."""
    geom = model.geom(name)
    mesh, turn = model.mesh(int(geom.dataid[0])), np.zeros(9)
    mujoco.mju_quat2Mat(turn, geom.quat)
    graph = model.mesh_graph[int(mesh.graphadr[0]) :]
    vertices, faces = int(graph[0]), int(graph[1])
    start = 2 + 3 * vertices + 3 * faces  # behind each vertex's edges and number, and the edges
    corners = model.mesh_vert[int(mesh.vertadr[0]) :][graph[start : start + 3 * faces]]
    return (corners @ turn.reshape(3, 3).T + geom.pos).reshape(-1, 3, 3)


def _miss(triangles: np.ndarray, kind: mujoco.mjtGeom, size: tuple[float, ...]) -> float:
    """Return the mean distance of triangles (F, 3, 3) in a simple shape's frame from its surface [m]: of their middles,
    weighted by their areas.
    """
    points = triangles.mean(axis=1)
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    if kind == KINDS.mjGEOM_SPHERE:
        miss = np.linalg.norm(points, axis=1) - size[0]
    elif kind == KINDS.mjGEOM_CAPSULE:
        along = np.clip(points[:, 2:], -size[1], size[1])
        miss = np.linalg.norm(np.concatenate([points[:, :2], points[:, 2:] - along], axis=1), axis=1) - size[0]
    else:
        beyond = np.abs(points) - size
        if kind == KINDS.mjGEOM_CYLINDER:
            beyond = np.stack([np.hypot(points[:, 0], points[:, 1]) - size[0], np.abs(points[:, 2]) - size[1]], axis=1)
        miss = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    return float(np.average(np.abs(miss), weights=areas))


def _keep_inertia(body: mujoco.MjsBody, model: mujoco.MjModel) -> None:
    """Give a body the mass and inertia that it has in `model`, so that they follow from its geoms no longer."""
    of = model.body(body.id)
    body.explicitinertial, body.mass = True, float(of.mass[0])
    body.ipos, body.iquat, body.inertia = of.ipos, of.iquat, of.inertia
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = np.full(6, np.nan)
