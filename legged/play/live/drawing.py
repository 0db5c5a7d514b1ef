"""Robots, a reference, arrows for velocities, and the ground in viser's scene. Meshes have a normal for each vertex."""

from typing import Any

import mujoco
import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor
from trimesh.visual import TextureVisuals
from trimesh.visual.color import srgb_to_linear
from trimesh.visual.material import PBRMaterial

from legged.envs import is_robot_task, is_velocity_task
from legged.envs.motion_tracking import is_tracking_task
from legged.math import yaw_of
from legged.play.live.plots import ACTUAL, COMMANDED
from legged.play.live.session import Session
from legged.rendering import camera
from legged.rendering.ghost import GHOST
from legged.rendering.scene import add_horizon, add_painted_terrain
from legged.robots.importing.convert import robot_spec_of
from legged.terrain import Terrain

GLIDE = np.array([0.25, 0.25, 0.06])
"""Share of the distance to the followed robot by which the view moves in each picture, along x, y, z. The view lags behind,
so that it shakes less with the robot's steps.
"""
CUT = 2.0
"""If the view is farther than this from the robot [m], the robot was moved to another place, and the view jumps there."""
ARROWS_EVERY = 3
"""Number of pictures after which the lengths of arrows are updated; their positions are updated in every picture."""
VIEW = np.array([-1.75, -2.1, 1.15])
"""First position of the browser's camera relative to the robot [lengths of the robot]."""
AMBIENT = 0.35
"""Brightness of the ambient light; if it is higher, light colours turn white."""
FOG, SKY = (25.0, 55.0), (255, 255, 255)
"""Distances at which the ground begins to fade, and at which it has faded completely [m]; and the background's colour."""
HIDDEN = -1000.0
"""Height at which arrows are out of sight [m]."""
NARROW = 700
"""Width of a screen below which viser puts the controls below the picture instead of next to it [pixels]."""
FARTHER, LOWER = 1.3, 1.0
"""On narrow screens: factor on the camera's distance, and how far below the robot the camera looks [lengths of the robot]."""
SEGMENTS = 16
"""Number of segments of round shapes along their circumference. It is small, because a browser may draw without a GPU."""
FLANK = 0.85
"""Brightness of the vertical faces of a terrain relative to its treads."""
SHARP = 30.0
"""Faces of a body meet in a sharp edge if the angle between their normals is larger than about this angle [degrees]."""
MATT = {"metallicFactor": 0.0, "roughnessFactor": 0.85}
PERIOD, HALF_PLANE = 2.0, 40.0
"""Period of a plane's checkerboard, and half the side of the drawn plane [m]. HALF_PLANE must be a multiple of PERIOD."""
Part = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices (V, 3) [m], faces (F, 3) and sRGB colours (V, 3), 0 to 1."""


class Drawing:
    """Robots and ground of a session in a viser scene. Everything is a child of the frame `/world`, which moves opposite to
    the followed robot. So this robot stays in the middle of the user's view.
    """

    def __init__(self, server: Any, session: Session) -> None:
        """Draw the session's robots and ground."""
        self.server, self.session = server, session
        self.follows = True
        self._turn = 0
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map("warehouse", environment_intensity=AMBIENT)
        server.scene.configure_fog(*FOG, color=SKY)
        self._world = server.scene.add_frame("/world", show_axes=False)
        self._handles: list[Any] = []
        self._above: list[Any] = []
        self._arrows: list[Any] = []
        self.build()
        server.initial_camera.position = tuple(VIEW * self.length)
        server.initial_camera.look_at = (0.0, 0.0, -0.1 * self.length)
        server.on_client_connect(self._fit_view)

    def _fit_view(self, client: Any) -> None:
        """On a narrow screen, show the robot in the upper half, because the controls cover the lower half."""
        if client.camera.image_width < NARROW:
            client.camera.position = tuple(FARTHER * VIEW * self.length)
            client.camera.look_at = (0.0, 0.0, -LOWER * self.length)

    def build(self) -> None:
        """Remove what was drawn, and draw the session's current task."""
        for handle in self._handles:
            handle.remove()
        scene = self.server.scene
        self._task = task = self.session.task
        terrain = getattr(task, "terrain", None)
        robots = range(task.num_envs)
        if is_robot_task(task):
            model, sides = robot_spec_of(task.robot.model_path, drawn=True).compile(), camera.size_of(task.robot)
            columns = int(np.ceil(task.num_envs**0.5))
        else:
            model = task.physics.model
            sides, columns = camera.size_of_model(model, model.qpos0), task.num_envs
        self.length = float(sides.max())
        self._model, self._data = model, mujoco.MjData(model)
        # On a plane all robots start in one place, so they are drawn with offsets (N, 3) [m] from their positions.
        self._offsets = camera.SPACING * self.length * camera.side_by_side(task.num_envs, columns)
        if terrain is not None:
            self._offsets[:] = 0.0
        self._plane = terrain is None
        ground = plane_mesh() if terrain is None else terrain_mesh(terrain)
        self._ground = scene.add_mesh_trimesh("/world/ground", ground, cast_shadow=False)
        meshes = body_meshes(model)
        self._bodies = list(meshes)
        self._nodes = [
            [scene.add_mesh_trimesh(f"/world/bodies/{robot}/{body}", mesh) for body, mesh in meshes.items()]
            for robot in robots
        ]
        if is_tracking_task(task):  # the last nodes are those of the followed robot's reference
            look = {"color": GHOST[:3], "opacity": GHOST[3], "cast_shadow": False}
            parts = [(f"/world/reference/{body}", mesh) for body, mesh in meshes.items()]
            self._nodes.append([scene.add_mesh_simple(name, mesh.vertices, mesh.faces, **look) for name, mesh in parts])
        self._above, self._arrows = [], []
        if is_velocity_task(task):  # each robot has arrows in a frame above it, which turns with its heading
            thick, nothing = 0.022 * self.length, np.full((2, 2, 3), HIDDEN, dtype=np.float32)
            heads = {"shaft_radius": thick, "head_radius": 2.2 * thick, "head_length": 4.0 * thick}
            colors = np.array([_light(COMMANDED), _light(ACTUAL)], dtype=np.uint8)
            names = [f"/world/above/{robot}" for robot in robots]
            self._above = [scene.add_frame(name, show_axes=False) for name in names]
            self._arrows = [scene.add_arrows(f"{name}/velocities", nothing, colors, **heads) for name in names]
        self._handles = [self._ground, *(node for nodes in self._nodes for node in nodes), *self._above]
        self._middle = self._pose(task.physics.qpos, self.session.followed)[0][1]
        self.draw()

    def _pose(self, qpos: Tensor, robot: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the drawn positions (nbody, 3), world frame [m], and orientations (nbody, 4) of the bodies of a robot, for
        `qpos` (N, nq). Body 1 is the base.
        """
        self._data.qpos[:] = np.nan_to_num(qpos[robot].cpu().numpy().astype(float))
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.xpos + self._offsets[robot], self._data.xquat.copy()

    def draw(self) -> None:
        """Update the poses, or build the scene anew if the session has another task."""
        if self._task is not self.session.task:
            self.build()
            return
        poses = [self._pose(self._task.physics.qpos, robot) for robot in range(self._task.num_envs)]
        bases = np.array([positions[1] for positions, _ in poses])
        if is_tracking_task(self._task):
            poses.append(self._pose(self._task.motion.now.qpos, self.session.followed))
        if self.follows:
            away = bases[self.session.followed] - self._middle
            share = 1.0 if np.linalg.norm(away) > CUT else GLIDE
            self._middle = self._middle + share * away
        with self.server.atomic():
            self._world.position = tuple(-self._middle)
            if self._plane:
                self._ground.position = (*(PERIOD * np.round(self._middle[:2] / PERIOD)), 0.0)
            for nodes, (positions, turns) in zip(self._nodes, poses, strict=True):
                for node, body in zip(nodes, self._bodies, strict=True):
                    node.position, node.wxyz = positions[body], turns[body]
            if self._above:
                self._draw_velocities(bases)

    def _draw_velocities(self, bases: np.ndarray) -> None:
        """Draw two arrows above each of `bases` (N, 3) [m]: the commanded velocity, and above it the actual one."""
        task = self._task
        half_yaw = 0.5 * yaw_of(task.base_quat).nan_to_num().cpu().numpy()
        for frame, base, half in zip(self._above, bases, half_yaw, strict=True):
            frame.position = base + np.array([0.0, 0.0, camera.ABOVE * self.length])
            frame.wxyz = (np.cos(half), 0.0, 0.0, np.sin(half))
        self._turn = (self._turn + 1) % ARROWS_EVERY
        if self._turn:
            return
        velocities = torch.stack([task.commands[:, :2], task.base_lin_vel[:, :2]], dim=1).cpu().numpy()
        for arrows, seen in zip(self._arrows, np.nan_to_num(velocities), strict=True):
            points = np.zeros((2, 2, 3), dtype=np.float32)
            points[1, :, 2] = camera.APART * self.length
            points[:, 1, :2] = camera.ARROW * seen
            points[np.linalg.norm(seen, axis=1) < camera.SLOWEST_SHOWN, :, 2] = HIDDEN
            if not np.array_equal(points, arrows.points):
                arrows.points = points


def _light(color: str) -> np.ndarray:
    """Return a colour such as '#0072B2' as linear intensities (3,), 0 to 255. Viser's arrows take these instead of sRGB."""
    return np.round(255.0 * srgb_to_linear(np.array(list(bytes.fromhex(color[1:]))) / 255.0))


# ---- shapes ------------------------------------------------------------------------------------------------------------


def body_meshes(model: mujoco.MjModel) -> dict[int, trimesh.Trimesh]:
    """Return body id -> mesh of the body's visible shapes, in the frame of the body [m]. The world has no mesh."""
    parts: dict[int, list[Part]] = {}
    for geom in range(model.ngeom):
        body, material, rgba = int(model.geom_bodyid[geom]), int(model.geom_matid[geom]), model.geom_rgba[geom]
        if material >= 0 and np.allclose(rgba, (0.5, 0.5, 0.5, 1.0)):  # MuJoCo's default: the geom itself has no colour
            rgba = model.mat_rgba[material]
        if body == 0 or rgba[3] == 0.0 or model.geom_group[geom] >= camera.COLLISION_SHAPES:
            continue
        mesh = geom_mesh(model, geom)
        if mesh is not None:
            parts.setdefault(body, []).append((mesh.vertices, mesh.faces, np.tile(rgba[:3], (len(mesh.vertices), 1))))
    return {body: _joined(own) for body, own in parts.items()}


def geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return a geom as a closed mesh in the frame of its body [m]; None for planes, height fields and lines."""
    size, types = model.geom_size[geom], mujoco.mjtGeom
    round_shape, edges = (SEGMENTS // 2, SEGMENTS), np.full(3, 1.0 / np.radians(SHARP))
    match model.geom_type[geom]:
        case types.mjGEOM_MESH:
            own = model.mesh(int(model.geom_dataid[geom]))
            vertices = model.mesh_vert[own.vertadr[0] :][: own.vertnum[0]]
            mesh = trimesh.Trimesh(vertices, model.mesh_face[own.faceadr[0] :][: own.facenum[0]], process=False)
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


def _split(mesh: trimesh.Trimesh, edges: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh with sharp edges. Faces share a vertex only if their normals, multiplied by `edges` (3,), round to equal
    numbers. If `edges` are zeros, all faces share their vertices, so the surface is smooth.
    """
    keys = np.column_stack([mesh.faces.reshape(-1), np.repeat(np.round(mesh.face_normals * edges), 3, axis=0)])
    kept, which = np.unique(keys, axis=0, return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[kept[:, 0].astype(int)], which.reshape(-1, 3), process=False)


def _with_visual(vertices: np.ndarray, faces: np.ndarray, visual: TextureVisuals) -> trimesh.Trimesh:
    """Return a mesh whose normal at each vertex is the mean normal of the adjacent faces, weighted by their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    sides, normals = np.cross(b - a, c - a), np.zeros(vertices.shape)  # trimesh's own normals are slow without scipy
    for corner in range(3):
        np.add.at(normals, faces[:, corner], sides)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


def _joined(parts: list[Part]) -> trimesh.Trimesh:
    """Return one mesh of several parts. Its colours are linear intensities, as glTF requires."""
    vertices, _, colors = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    starts = np.cumsum([0, *(len(points) for points, _, _ in parts)])
    faces = np.concatenate([own + start for (_, own, _), start in zip(parts, starts, strict=False)])
    visual = TextureVisuals(material=PBRMaterial(**MATT))
    light = np.column_stack([srgb_to_linear(colors), np.ones(len(colors))])
    visual.vertex_attributes["color"] = np.round(255.0 * light).astype(np.uint8)
    return _with_visual(vertices, faces, visual)


def terrain_mesh(terrain: Terrain) -> trimesh.Trimesh:
    """Return a mesh of a terrain and of level ground around it, world frame [m]. The mesh is the surface on which the C
    engine computes collisions: steps with vertical faces, and smooth tiles. Colours are as in films.
    """
    scene = mujoco.MjSpec()
    add_painted_terrain(scene, terrain, checkered=True)
    add_horizon(scene, terrain)
    model = scene.compile()
    boxes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    box = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    corners = box.vertices[box.faces].reshape(-1, 3)
    brightness = np.repeat(np.where(box.face_normals[:, 2] > 0.5, 1.0, FLANK), 3)
    vertices = (model.geom_pos[boxes, None] + model.geom_size[boxes, None] * corners).reshape(-1, 3)
    colors = (model.geom_rgba[boxes, None, :3] * brightness[:, None]).reshape(-1, 3)
    parts = [(vertices, np.arange(len(vertices)).reshape(-1, 3), colors)]
    return _joined(
        [*parts, *(_surface(model, int(i)) for i in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD))]
    )


def _surface(model: mujoco.MjModel, geom: int) -> Part:
    """Return the upper side of a height field in its texture's colours. It has the same triangles as in MuJoCo."""
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, high, _ = model.hfield_size[field]
    heights = high * model.hfield_data[model.hfield_adr[field] :][: rows * columns].astype(float)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    vertices = np.column_stack([x.ravel(), y.ravel(), heights]) + model.geom_pos[geom]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + columns], axis=1)
    other = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    texture = model.mat_texid[model.geom_matid[geom], mujoco.mjtTextureRole.mjTEXROLE_RGB]
    colors = model.tex_data[model.tex_adr[texture] :][: 3 * rows * columns].reshape(-1, 3) / 255.0
    return vertices, np.concatenate([one, other]), colors


def plane_mesh() -> trimesh.Trimesh:
    """Return a square of level ground around the origin. Its checkerboard of dark and light cells makes motion visible."""
    light = np.array([209.0, 214.0, 219.0])
    squares = np.kron([[1.0, 0.94], [0.94, 1.0]], np.ones((128, 128)))[:, :, None] * light
    corners = HALF_PLANE * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    material = PBRMaterial(baseColorTexture=Image.fromarray(squares.astype(np.uint8)), **MATT)
    visual = TextureVisuals(uv=corners[:, :2] / PERIOD, material=material)
    return _with_visual(corners, np.array([[0, 1, 2], [0, 2, 3]]), visual)
