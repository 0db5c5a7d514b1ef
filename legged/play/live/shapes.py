"""Triangle meshes of a model's bodies and of a terrain, with a normal and a colour per vertex, for viser's scene."""

from typing import Any

import mujoco
import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.color import srgb_to_linear
from trimesh.visual.material import PBRMaterial

from legged.rendering.camera import COLLISION_SHAPES
from legged.rendering.scene import add_horizon, add_painted_terrain
from legged.terrain import Terrain

SEGMENTS = 16
"""Segments of round shapes along their circumference: few, because a browser may draw without a GPU."""
FLANK = 0.85
"""Brightness of the vertical faces of a terrain relative to its treads."""
SHARP = 30.0
"""Faces of a body that meet at a larger angle keep their edge [degrees]."""
MATT = {"metallicFactor": 0.0, "roughnessFactor": 0.85}
PERIOD, HALF_PLANE = 2.0, 40.0
"""Distance after which the squares of a plane repeat, and half the side of the drawn part, a multiple of it [m]."""


def body_meshes(model: mujoco.MjModel) -> dict[int, trimesh.Trimesh]:
    """Return the visible shapes of each body of a model except the world, in the frame of the body [m]."""
    meshes: dict[int, list[trimesh.Trimesh]] = {}
    colors: dict[int, list[np.ndarray]] = {}
    for geom in range(model.ngeom):
        body, rgba = int(model.geom_bodyid[geom]), rgba_of(model, geom)
        if body == 0 or rgba[3] == 0.0 or model.geom_group[geom] >= COLLISION_SHAPES:
            continue
        mesh = geom_mesh(model, geom)
        if mesh is not None:
            meshes.setdefault(body, []).append(mesh)
            colors.setdefault(body, []).append(np.tile(rgba[:3], (len(mesh.vertices), 1)))
    joined: dict[int, Any] = {body: trimesh.util.concatenate(parts) for body, parts in meshes.items()}
    return {body: _coloured(mesh.vertices, mesh.faces, np.concatenate(colors[body])) for body, mesh in joined.items()}


def rgba_of(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour (4,) of a geom, 0 to 1: its own, or else that of its material."""
    material = int(model.geom_matid[geom])
    own = np.asarray(model.geom_rgba[geom])
    if material >= 0 and np.allclose(own, (0.5, 0.5, 0.5, 1.0)):  # MuJoCo's default: the file sets no colour
        return np.asarray(model.mat_rgba[material])
    return own


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return a geom as a closed mesh in the frame of its body [m]; None for planes, height fields and lines."""
    size, types = model.geom_size[geom], mujoco.mjtGeom
    round_shape, edges = (SEGMENTS // 2, SEGMENTS), np.full(3, 1.0 / np.radians(SHARP))
    match model.geom_type[geom]:
        case types.mjGEOM_MESH:
            mesh = _mesh_asset(model, model.geom_dataid[geom])
        case types.mjGEOM_BOX:
            mesh = trimesh.creation.box(extents=2.0 * size)
        case types.mjGEOM_SPHERE | types.mjGEOM_ELLIPSOID as kind:
            mesh, edges = trimesh.creation.uv_sphere(count=round_shape), np.zeros(3)
            mesh.apply_scale(size if kind == types.mjGEOM_ELLIPSOID else size[0])
        case types.mjGEOM_CAPSULE:
            mesh, edges = trimesh.creation.capsule(2.0 * size[1], size[0], count=round_shape), np.zeros(3)
        case types.mjGEOM_CYLINDER:
            mesh, edges = trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=SEGMENTS), np.array([0.0, 0.0, 1.0])
        case _:
            return None
    pose = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])
    pose[:3, 3] = model.geom_pos[geom]
    return _split(mesh, edges).apply_transform(pose)


def _mesh_asset(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    """Return a mesh asset of a model in its own frame [m]."""
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    return trimesh.Trimesh(vertices, faces, process=False)


def _split(mesh: trimesh.Trimesh, edges: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh with sharp edges: faces share a vertex only where their normals, in `edges` (3,) steps per unit length,
    round to the same numbers. With zeros all faces share their vertices, so the surface is smooth.
    """
    keys = np.column_stack([mesh.faces.reshape(-1), np.repeat(np.round(mesh.face_normals * edges), 3, axis=0)])
    kept, which = np.unique(keys, axis=0, return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[kept[:, 0].astype(int)], which.reshape(-1, 3), process=False)


def _with_visual(vertices: np.ndarray, faces: np.ndarray, visual: TextureVisuals) -> trimesh.Trimesh:
    """Return a mesh whose normal at a vertex is the mean of the normals of its faces, weighted by their area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    sides, normals = np.cross(b - a, c - a), np.zeros(vertices.shape)  # without scipy trimesh needs a slow loop
    for corner in range(3):
        np.add.at(normals, faces[:, corner], sides)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


def _coloured(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh with sRGB colours (V, 3), 0 to 1; files hold them as linear intensities, as glTF wants."""
    visual = TextureVisuals(material=PBRMaterial(**MATT))
    light = np.column_stack([srgb_to_linear(colors), np.ones(len(colors))])
    visual.vertex_attributes["color"] = np.round(255.0 * light).astype(np.uint8)
    return _with_visual(vertices, faces, visual)


def terrain_mesh(terrain: Terrain) -> trimesh.Trimesh:
    """Return a terrain as the C engine collides with it, world frame [m], with the colours of films and level ground around:
    the tops and vertical faces of its steps, and the surface of its smooth tiles.
    """
    scene = mujoco.MjSpec()
    add_painted_terrain(scene, terrain, checkered=True)
    add_horizon(scene, terrain)
    model = scene.compile()
    boxes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    box = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    corners = box.vertices[box.faces].reshape(-1, 3)
    brightness = np.repeat(np.where(box.face_normals[:, 2] > 0.5, 1.0, FLANK), 3)
    vertices = [(model.geom_pos[boxes, None] + model.geom_size[boxes, None] * corners).reshape(-1, 3)]
    faces = [np.arange(len(vertices[0])).reshape(-1, 3)]
    colors = [(model.geom_rgba[boxes, None, :3] * brightness[:, None]).reshape(-1, 3)]
    start = len(vertices[0])
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD):
        points, triangles = _surface(model, int(geom))
        texture = model.mat_texid[model.geom_matid[geom], mujoco.mjtTextureRole.mjTEXROLE_RGB]
        vertices.append(points)
        faces.append(triangles + start)
        colors.append(model.tex_data[model.tex_adr[texture] :][: 3 * len(points)].reshape(-1, 3) / 255.0)
        start += len(points)
    return _coloured(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors))


def _surface(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper side of a height field as vertices (V, 3), world frame [m], and faces (F, 3), split into triangles as
    MuJoCo splits it.
    """
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, high, _ = model.hfield_size[field]
    heights = high * model.hfield_data[model.hfield_adr[field] :][: rows * columns].astype(float)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    vertices = np.column_stack([x.ravel(), y.ravel(), heights]) + model.geom_pos[geom]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + columns], axis=1)
    other = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return vertices, np.concatenate([one, other])


def plane_mesh() -> trimesh.Trimesh:
    """Return a square of the ground around the origin, with dark and light squares of half the PERIOD, which show motion."""
    light = np.array([209.0, 214.0, 219.0])
    squares = np.kron([[1.0, 0.94], [0.94, 1.0]], np.ones((128, 128)))[:, :, None] * light
    corners = HALF_PLANE * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    material = PBRMaterial(baseColorTexture=Image.fromarray(squares.astype(np.uint8)), **MATT)
    visual = TextureVisuals(uv=corners[:, :2] / PERIOD, material=material)
    return _with_visual(corners, np.array([[0, 1, 2], [0, 2, 3]]), visual)
