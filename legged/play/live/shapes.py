"""What a model and a terrain look like, as coloured triangles."""

from dataclasses import dataclass

import mujoco
import numpy as np

from legged.physics.scene.terrain_geoms import add_terrain
from legged.rendering.camera import COLLISION_SHAPES
from legged.rendering.paint import CHECKER, LEVEL_RANGE, MIDDLE, SHOWN_DEPTH, SQUARE, color
from legged.terrain import Terrain

AROUND, ALONG = 16, 5
"""Sides of what is round, and rings of its caps: coarse, since a browser may draw without a GPU."""
FLANK = 0.85
"""Brightness of vertical faces of a terrain, beside that of treads."""
SHARP = 30.0
"""Faces of a mesh that meet at more than this keep their edge [degrees]."""
MARGIN = 30.0
"""Level ground that is drawn around a terrain [m]."""
TILES = 40
"""Squares of 1 m on each side of the middle of a plane."""

Triangles = tuple[np.ndarray, np.ndarray]
"""(V, 3) vertices [m] and (F, 3) faces that name them, counterclockwise as seen from outside."""


@dataclass(frozen=True)
class Painted:
    """Triangles with a colour at each vertex."""

    vertices: np.ndarray
    """(V, 3) in the frame of a body, or of the world [m]."""
    faces: np.ndarray
    """(F, 3) of the vertices."""
    colors: np.ndarray
    """(V, 3) red, green and blue, 0 to 255."""


def bodies_of(model: mujoco.MjModel) -> dict[int, Painted]:
    """Return what can be seen of each body of a model but the world, without shapes that are only touched."""
    found: dict[int, list[tuple[Triangles, np.ndarray]]] = {}
    for geom in range(model.ngeom):
        body, rgba, triangles = int(model.geom_bodyid[geom]), rgba_of(model, geom), triangles_of(model, geom)
        if triangles is None or body == 0 or rgba[3] == 0.0 or model.geom_group[geom] >= COLLISION_SHAPES:
            continue
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        placed = triangles[0] @ turn.reshape(3, 3).T + model.geom_pos[geom], triangles[1]
        found.setdefault(body, []).append((placed, np.tile(255.0 * rgba[:3], (len(placed[0]), 1))))
    return {
        body: Painted(*joined([triangles for triangles, _ in parts]), np.concatenate([colors for _, colors in parts]))
        for body, parts in found.items()
    }


def rgba_of(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour (4,) of a geom, 0 to 1: its own, or else that of its material."""
    material = int(model.geom_matid[geom])
    own = np.asarray(model.geom_rgba[geom])
    if material >= 0 and np.allclose(own, (0.5, 0.5, 0.5, 1.0)):  # MuJoCo's default, which no file asked for
        return np.asarray(model.mat_rgba[material])
    return own


def joined(parts: list[Triangles]) -> Triangles:
    """Return several sets of triangles as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])[:-1]
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def triangles_of(model: mujoco.MjModel, geom: int) -> Triangles | None:
    """Return a geom as triangles in its own frame; None of what is no solid."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind == types.mjGEOM_BOX:
        return box(size)
    if kind == types.mjGEOM_SPHERE:
        return capsule(float(size[0]), 0.0)
    if kind == types.mjGEOM_ELLIPSOID:
        vertices, faces = capsule(1.0, 0.0)
        return vertices * size, faces
    if kind == types.mjGEOM_CAPSULE:
        return capsule(float(size[0]), float(size[1]))
    if kind == types.mjGEOM_CYLINDER:
        return cylinder(float(size[0]), float(size[1]))
    return None


def box(half: np.ndarray) -> Triangles:
    """Return a box of half sides (3,) [m], whose faces share no vertex: its edges are sharp."""
    vertices: list[list[np.ndarray]] = []
    faces: list[np.ndarray] = []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for sign in (-1.0, 1.0):
            out = sign * np.eye(3)[axis]
            corners = [out - u - v, out + u - v, out + u + v, out - u + v]
            quad = 4 * len(faces) + np.array([[0, 1, 2], [0, 2, 3]])
            vertices.append(corners if sign > 0.0 else corners[::-1])
            faces.append(quad)
    return np.concatenate(vertices) * half, np.concatenate(faces)


def capsule(radius: float, half: float) -> Triangles:
    """Return a capsule along z whose middle part has the half length `half`; a sphere where that is 0 [m]."""
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * ALONG)
    rings = [(radius * np.cos(a), radius * np.sin(a) + np.copysign(half, a)) for a in angles]
    return _turned(rings)


def cylinder(radius: float, half: float) -> Triangles:
    """Return a cylinder along z of half length `half` [m]; its rims are sharp."""
    parts = [_turned([(radius, -half), (radius, half)])]
    parts += [_turned([(0.0, -half), (radius, -half)]), _turned([(radius, half), (0.0, half)])]
    return joined(parts)


def _turned(rings: list[tuple[float, float]]) -> Triangles:
    """Return what a line of (radius, z) [m], from below upwards, becomes when it is turned around the z axis."""
    angles = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.column_stack([r * around, np.full(AROUND, z)]) for r, z in rings])
    here = np.arange(AROUND)
    right = (here + 1) % AROUND
    faces = []
    for ring in range(len(rings) - 1):
        low, high = ring * AROUND, (ring + 1) * AROUND
        faces.append(np.stack([low + here, low + right, high + right], axis=1))
        faces.append(np.stack([low + here, high + right, high + here], axis=1))
    return vertices, np.concatenate(faces)


def _mesh(model: mujoco.MjModel, mesh: int) -> Triangles:
    """Return a mesh of the model. Vertices on sharp edges are told apart, so that these are drawn sharp."""
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    first, number = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertices = np.array(model.mesh_vert[start : start + count], dtype=float)
    faces = np.array(model.mesh_face[first : first + number], dtype=int)
    sides = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    normals = sides / np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), 1e-12)
    # Faces around a vertex that look nearly the same way share it: their normals, in coarse steps, are the same.
    coarse = np.round(normals / np.radians(SHARP)).astype(int)
    keys = np.column_stack([faces.reshape(-1), np.repeat(coarse, 3, axis=0)])
    kept, which = np.unique(keys, axis=0, return_inverse=True)
    return vertices[kept[:, 0]], which.reshape(-1, 3)


# ---- ground ------------------------------------------------------------------------------------------------------------


def terrain_shape(terrain: Terrain) -> Painted:
    """Return a terrain as the C engine collides with it, coloured by height: the tops and vertical faces of its steps, and
    its smooth tiles; with level ground around.
    """
    scene = mujoco.MjSpec()
    add_terrain(scene, terrain, collide=False, depth=SHOWN_DEPTH)
    model = scene.compile()
    span = max(LEVEL_RANGE, float(np.abs(terrain.height_map.corners).max()))
    parts, colors = [], []
    for geom in range(model.ngeom):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
            vertices, faces = box(model.geom_size[geom])
            vertices = vertices + model.geom_pos[geom]
            top = float(vertices[:, 2].max())
            flank = np.repeat(np.array([FLANK] * 5 + [1.0]), 4)  # the upper face is the last one
            shade = flank[:, None] * color(np.array(top), span)
        else:
            vertices, faces = _surface(model, geom)
            dark = ((vertices[:, 0] // SQUARE + vertices[:, 1] // SQUARE) % 2 > 0)[:, None]
            shade = color(vertices[:, 2], span) * np.where(dark, *CHECKER)
        parts.append((vertices, faces))
        colors.append(shade)
    x, y = (0.5 * side for side in terrain.height_map.size)
    for low, high in (
        ((-x - MARGIN, -y - MARGIN), (-x, y + MARGIN)),
        ((x, -y - MARGIN), (x + MARGIN, y + MARGIN)),
        ((-x, -y - MARGIN), (x, -y)),
        ((-x, y), (x, y + MARGIN)),
    ):
        parts.append(_level(low, high))
        colors.append(np.tile(MIDDLE, (4, 1)))
    vertices, faces = joined(parts)
    return Painted(vertices, faces, 255.0 * np.concatenate(colors))


def _surface(model: mujoco.MjModel, geom: int) -> Triangles:
    """Return the upper side of a height field, world frame, split into triangles as MuJoCo splits it."""
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = int(model.hfield_adr[field])
    half_x, half_y, high, _ = model.hfield_size[field]
    heights = high * np.array(model.hfield_data[start : start + rows * columns])
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    vertices = np.column_stack([x.ravel(), y.ravel(), heights]) + model.geom_pos[geom]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + columns], axis=1)
    other = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return vertices, np.concatenate([one, other])


def _level(low: tuple[float, float], high: tuple[float, float]) -> Triangles:
    """Return a rectangle at height 0 between two corners, world frame [m]."""
    vertices = np.array([[*low, 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def plane_shape() -> Painted:
    """Return squares of 1 m around the origin, dark and light in turn, that show a plane moving by."""
    cells = np.arange(-TILES, TILES)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    x, y = (grid.ravel() for grid in np.meshgrid(cells, cells, indexing="ij"))
    vertices = (np.stack([x, y], axis=1)[:, None] + corners).reshape(-1, 2).astype(float)
    first = 4 * np.arange(len(x))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    shade = np.where((x + y) % 2 > 0, 0.94, 1.0)[:, None] * np.array([0.82, 0.84, 0.86])
    colors = np.repeat(255.0 * shade, 4, axis=0)
    return Painted(np.column_stack([vertices, np.zeros(len(vertices))]), faces, colors)
