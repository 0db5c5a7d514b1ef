"""Robots, their velocities and the ground in viser's scene."""

from typing import Any

import mujoco
import numpy as np
import torch
from trimesh.visual.color import srgb_to_linear

from legged.envs import LeggedRobot
from legged.play.live.plots import ACTUAL, COMMANDED
from legged.play.live.session import Session
from legged.play.live.shapes import PERIOD, body_meshes, plane_mesh, terrain_mesh
from legged.rendering.framing import side_by_side, size_of, size_of_model
from legged.rendering.task_cameras import ABOVE, APART, SPACING
from legged.robots.importing.convert import robot_spec_of

GLIDE = np.array([0.25, 0.25, 0.06])
"""Share of the distance to the followed robot that the view covers per picture, along x, y, z: steps then shake it less."""
CUT = 2.0
"""Distance above which the view jumps to the robot at once, because the robot was put somewhere else [m]."""
ARROW = 0.6
"""Length of an arrow for 1 m/s [m]."""
ARROWS_EVERY = 3
"""Arrows move along in every picture; their lengths change in one of so many."""
SLOWEST_SHOWN = 0.03
"""Slower robots have no arrow [m/s]."""
VIEW = np.array([-1.75, -2.1, 1.15])
"""First position of the browser's camera relative to the robot, in lengths of a robot."""
AMBIENT = 0.35
"""Brightness of the ambient light; with more, light colours turn white."""
FOG, SKY = (25.0, 55.0), (255, 255, 255)
"""Distances between which the ground fades into the background [m], and the background's colour."""
HIDDEN = -1000.0
"""Height of hidden arrows [m]."""
NARROW = 700
"""Screens below this width have the controls below the picture instead of next to it [pixels]."""
FARTHER, LOWER = 1.3, 1.0
"""On narrow screens the camera is so many times as far away and looks at a point so far below the robot, in its lengths."""


class Drawing:
    """Robots and ground of a session in a viser scene. Everything is a child of the frame `/world`, which moves opposite to
    the followed robot. So the robot stays in the middle, and the user's view of it is kept.
    """

    def __init__(self, server: Any, session: Session) -> None:
        """Draw the session's robots and ground."""
        self.server, self.session = server, session
        self.follows = True
        self._middle = np.zeros(3)
        self._turn = 0
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map("warehouse", environment_intensity=AMBIENT)
        server.scene.configure_fog(*FOG, color=SKY)
        self._world = server.scene.add_frame("/world", show_axes=False)
        self._task: Any = None
        self._handles: list[Any] = []
        self.build()
        server.initial_camera.position = tuple(VIEW * self.length)
        server.initial_camera.look_at = (0.0, 0.0, -0.1 * self.length)
        server.on_client_connect(self._fit_view)

    def _fit_view(self, client: Any) -> None:
        """Move the robot to the upper half of a narrow screen, whose lower half has the controls."""
        if client.camera.image_width < NARROW:
            client.camera.position = tuple(FARTHER * VIEW * self.length)
            client.camera.look_at = (0.0, 0.0, -LOWER * self.length)

    def build(self) -> None:
        """Replace everything drawn by the session's current task."""
        for handle in self._handles:
            handle.remove()
        session, scene = self.session, self.server.scene
        self._task = task = session.task
        model, size = self._model()
        self.length = size.longest
        self._model_drawn, self._data = model, mujoco.MjData(model)
        self._offsets = self._side_by_side(task.num_envs)
        terrain = getattr(task, "terrain", None)
        self._plane = terrain is None
        ground = plane_mesh() if terrain is None else terrain_mesh(terrain)
        self._ground = scene.add_mesh_trimesh("/world/ground", ground, cast_shadow=False)
        meshes = body_meshes(model)
        self._bodies = list(meshes)
        self._nodes = [
            [scene.add_mesh_trimesh(f"/world/bodies/{robot}/{body}", mesh) for body, mesh in meshes.items()]
            for robot in range(task.num_envs)
        ]
        self._handles = [self._ground, *(node for nodes in self._nodes for node in nodes)]
        self._above: list[Any] = []
        self._arrows: list[Any] = []
        if isinstance(task, LeggedRobot):
            self._add_arrows(task.num_envs)
        self._middle = self._base(session.followed)
        self.draw()

    def _add_arrows(self, count: int) -> None:
        """Add arrows above robots, in frames that share the robots' heading."""
        scene, thick = self.server.scene, 0.022 * self.length
        colors = np.array([_light(COMMANDED), _light(ACTUAL)], dtype=np.uint8)
        for robot in range(count):
            self._above.append(scene.add_frame(f"/world/above/{robot}", show_axes=False))
            self._arrows.append(
                scene.add_arrows(
                    f"/world/above/{robot}/velocities",
                    np.full((2, 2, 3), HIDDEN, dtype=np.float32),
                    colors,
                    shaft_radius=thick,
                    head_radius=2.2 * thick,
                    head_length=4.0 * thick,
                )
            )
        self._handles += self._above

    def _model(self) -> tuple[mujoco.MjModel, Any]:
        """Return the model whose bodies are drawn, and its size."""
        task = self._task
        if isinstance(task, LeggedRobot):
            return robot_spec_of(task.robot.model_path, drawn=True).compile(), size_of(task.robot)
        model = task.physics.model
        return model, size_of_model(model, model.qpos0)

    def _side_by_side(self, count: int) -> np.ndarray:
        """Return offsets (N, 3) between where robots are and where they are drawn [m]; on a plane all start in one place."""
        if getattr(self._task, "terrain", None) is not None:
            return np.zeros((count, 3))
        columns = int(np.ceil(count**0.5)) if isinstance(self._task, LeggedRobot) else count
        return SPACING * self.length * side_by_side(count, columns)

    def _base(self, robot: int) -> np.ndarray:
        """Return the drawn position (3,) of a robot's base, world frame [m]; sets the poses of all its bodies."""
        qpos = np.nan_to_num(self._task.physics.qpos[robot].cpu().numpy().astype(float))
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model_drawn, self._data)
        return np.asarray(self._data.xpos[1]) + self._offsets[robot]

    def draw(self) -> None:
        """Update the poses; build the scene anew if the session has another task."""
        if self._task is not self.session.task:
            self.build()
            return
        count = self._task.num_envs
        poses = []
        bases = np.zeros((count, 3))
        for robot in range(count):
            bases[robot] = self._base(robot)
            poses.append((self._data.xpos[self._bodies] + self._offsets[robot], self._data.xquat[self._bodies].copy()))
        if self.follows:
            away = bases[self.session.followed] - self._middle
            share = 1.0 if np.linalg.norm(away) > CUT else GLIDE
            self._middle = self._middle + share * away
        with self.server.atomic():
            self._world.position = tuple(-self._middle)
            if self._plane:
                self._ground.position = (*(PERIOD * np.round(self._middle[:2] / PERIOD)), 0.0)
            for nodes, (positions, turns) in zip(self._nodes, poses, strict=True):
                for node, position, turn in zip(nodes, positions, turns, strict=True):
                    node.position, node.wxyz = position, turn
            if self._above:
                self._draw_velocities(bases)

    def _draw_velocities(self, bases: np.ndarray) -> None:
        """Draw two arrows above each of `bases` (N, 3) [m]: the commanded velocity, and above it the actual one."""
        task = self._task
        w, x, y, z = np.nan_to_num(task.base_quat.cpu().numpy().astype(float)).T
        half_yaw = 0.5 * np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        for frame, base, half in zip(self._above, bases, half_yaw, strict=True):
            frame.position = base + np.array([0.0, 0.0, ABOVE * self.length])
            frame.wxyz = (np.cos(half), 0.0, 0.0, np.sin(half))
        self._turn = (self._turn + 1) % ARROWS_EVERY
        if self._turn:
            return
        velocities = torch.stack([task.commands[:, :2], task.base_lin_vel[:, :2]], dim=1).cpu().numpy()
        for arrows, seen in zip(self._arrows, np.nan_to_num(velocities), strict=True):
            points = np.zeros((2, 2, 3), dtype=np.float32)
            points[1, :, 2] = APART * self.length
            points[:, 1, :2] = ARROW * seen
            points[np.linalg.norm(seen, axis=1) < SLOWEST_SHOWN, :, 2] = HIDDEN
            if not np.array_equal(points, arrows.points):
                arrows.points = points


def _light(color: str) -> np.ndarray:
    """Return a colour such as '#0072B2' as linear intensities (3,), 0 to 255, which arrows take instead of sRGB."""
    return np.round(255.0 * srgb_to_linear(np.array(list(bytes.fromhex(color[1:]))) / 255.0))
