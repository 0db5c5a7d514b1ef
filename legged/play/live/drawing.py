"""What the page draws: the robots, their velocities and the ground, in viser's scene, which keeps the followed robot in its
middle.
"""

from typing import Any

import mujoco
import numpy as np
import torch

from legged.envs import LeggedRobot
from legged.play.live.glb import glb, linear
from legged.play.live.plots import ACTUAL, COMMANDED
from legged.play.live.session import Session
from legged.play.live.shapes import bodies_of, plane_shape, terrain_shape
from legged.rendering.robots_camera import ABOVE, APART, SPACING
from legged.rendering.size import size_of, size_of_model
from legged.robots.importing.adapted import robot_spec_of

GLIDE = np.array([0.25, 0.25, 0.06])
"""Share of the way to the followed robot that the camera makes up in a picture, along x, y and z: steps must not shake it."""
CUT = 2.0
"""From farther away than this it does not glide, it is there at once: the robot has been put somewhere else [m]."""
ARROW = 0.6
"""Length of an arrow for 1 m/s [m]."""
ARROWS_EVERY = 3
"""Arrows move along in every picture, and change their length in one of so many."""
SLOWEST_SHOWN = 0.03
"""Slower robots have no arrow [m/s]."""
VIEW = np.array([-1.75, -2.1, 1.15])
"""From where one looks at first, in lengths of a robot."""
AMBIENT = 0.35
"""Brightness of the light from all around, beside viser's own: with more, light colours are white."""
FOG, SKY = (25.0, 55.0), (255, 255, 255)
"""Distances between which the ground goes over into the background [m], and its colour."""
HIDDEN = -1000.0
"""Height of what is not to be seen [m]."""
NARROW = 700
"""Screens that are narrower have the controls below the picture, not beside it [pixels]."""
FARTHER, LOWER = 1.3, 1.0
"""There one looks from so many times as far away, at a point so far below the robot, in its lengths."""
SQUARE = 2.0
"""Length after which the squares of a plane look the same: they are moved along by multiples of it [m]."""


class Drawing:
    """Robots and ground of a session in a viser scene. Everything hangs on one frame, `/world`, which moves the other way
    when the camera follows a robot: so the view stays the user's to turn.
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
        server.on_client_connect(self._suit)

    def _suit(self, client: Any) -> None:
        """Let a narrow screen, whose lower half has the controls, show the robot in its upper one."""
        if client.camera.image_width < NARROW:
            client.camera.position = tuple(FARTHER * VIEW * self.length)
            client.camera.look_at = (0.0, 0.0, -LOWER * self.length)

    def build(self) -> None:
        """Draw everything anew: the task is another one."""
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
        ground = plane_shape() if terrain is None else terrain_shape(terrain)
        self._ground = scene.add_glb("/world/ground", glb(ground.vertices, ground.faces, ground.colors), cast_shadow=False)
        shown = {body: glb(look.vertices, look.faces, look.colors) for body, look in bodies_of(model).items()}
        self._bodies = list(shown)
        self._nodes = [
            [scene.add_glb(f"/world/bodies/{robot}/{body}", data) for body, data in shown.items()]
            for robot in range(task.num_envs)
        ]
        self._handles = [self._ground, *(node for nodes in self._nodes for node in nodes)]
        self._above: list[Any] = []
        self._arrows: list[Any] = []
        if isinstance(task, LeggedRobot):
            self._add_arrows(task.num_envs)
        self._jump()
        self.draw()

    def _add_arrows(self, count: int) -> None:
        """Add arrows above robots, in frames that turn about the vertical axis with them."""
        scene, thick = self.server.scene, 0.022 * self.length
        colors = np.array([_rgb(COMMANDED), _rgb(ACTUAL)], dtype=np.uint8)
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
        """Return the model whose bodies are drawn, and how large they are."""
        task = self._task
        if isinstance(task, LeggedRobot):
            return robot_spec_of(task.robot.model_path, drawn=True).compile(), size_of(task.robot)
        model = task.physics.model
        return model, size_of_model(model, model.qpos0)

    def _side_by_side(self, count: int) -> np.ndarray:
        """Return how far robots are drawn from where they are, (N, 3) [m]: on a plane all of them start in one place."""
        offsets = np.zeros((count, 3))
        if getattr(self._task, "terrain", None) is None:
            columns = int(np.ceil(count**0.5)) if isinstance(self._task, LeggedRobot) else count
            grid = np.array([[-(i // columns), i % columns] for i in range(count)], dtype=float)
            offsets[:, :2] = SPACING * self.length * (grid - grid.mean(axis=0))
        return offsets

    def _jump(self) -> None:
        """Look at the followed robot at once."""
        self._middle = self._base(self.session.followed)

    def _base(self, robot: int) -> np.ndarray:
        """Return where a robot is drawn (3,), world frame [m]."""
        qpos = np.nan_to_num(self._task.physics.qpos[robot].cpu().numpy().astype(float))
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model_drawn, self._data)
        return np.asarray(self._data.xpos[1]) + self._offsets[robot]

    def draw(self) -> None:
        """Show where the robots are now; draw anew where the task is another one."""
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
                self._ground.position = (*(SQUARE * np.round(self._middle[:2] / SQUARE)), 0.0)
            for nodes, (positions, turns) in zip(self._nodes, poses, strict=True):
                for node, position, turn in zip(nodes, positions, turns, strict=True):
                    node.position, node.wxyz = position, turn
            if self._above:
                self._draw_velocities(bases)

    def _draw_velocities(self, bases: np.ndarray) -> None:
        """Put arrows above robots at `bases` (N, 3) [m]: the commanded velocity, and above it the actual one."""
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


def _rgb(color: str) -> tuple[int, ...]:
    """Return a colour such as '#0072B2' as the light of arrows, 0 to 255: they take it for that, and not for a screen's."""
    return tuple(round(255.0 * float(linear(np.array(int(color[i : i + 2], 16))))) for i in (1, 3, 5))
