"""Pictures of several legged robots in one scene, with commanded and actual velocity drawn in."""

from collections.abc import Sequence
from itertools import product

import mujoco
import numpy as np

from legged.envs import LeggedRobot
from legged.rendering.camera import Camera
from legged.rendering.follower import Follower
from legged.rendering.framing import frame
from legged.rendering.scene import display_model
from legged.rendering.size import size_of
from legged.rendering.text import caption
from legged.terrain import HeightMap

COMMANDED = (0.10, 0.75, 0.25, 1.0)
ACTUAL = (0.15, 0.45, 0.95, 1.0)
SHADE = (0.05, 0.05, 0.05, 0.4)
SPACING = 1.82
"""Distance between neighbours on a plane, in lengths of a robot: 1.9 m for ANYmal C."""
FOLLOWED_FROM = 3.45
"""Distance of the camera that follows a robot over terrain, in lengths of a robot: 3.6 m for ANYmal C."""
NEAR, FARTHER = 1.92, 1.05
"""Distance of the camera on a plane, and what it adds with the root of the number of robots, in lengths of a robot."""
ABOVE, APART = 0.335, 0.086
"""Height of the lower arrow above the base, and of the upper above it, in lengths of a robot."""
GLIDE = 0.1
"""Share of the way to the robots that the camera on a plane makes up in a picture: steps must not shake it."""
SPOT, LIFTED = 0.086, 0.38
"""Radius of the spot below a foot on the ground, and height at which it is smallest, in lengths of a robot."""


class RobotsCamera(Camera):
    """Draws `count` robots of a task, the first ones until `turn_to` says otherwise: on a plane side by side, from a camera
    that follows them all; on terrain where they are, from one that follows the robot `followed` of them.
    """

    def __init__(
        self,
        task: LeggedRobot,
        count: int,
        width: int = 960,
        height: int = 540,
        instead: str = ", or play with --no-video",
    ) -> None:
        """Build the scene and its renderer.

        Raises:
            RunError: nothing can be rendered; `instead` is what the user might do then.
        """
        model = display_model(task.robot, count, width, height, task.terrain)
        super().__init__(model, width, height, instead)
        self.task, self.count = task, count
        self.first, self.followed = 0, 0
        self.size = size_of(task.robot)
        length = self.size.longest
        self.view.azimuth, self.view.elevation = 130.0, -18.0
        self.view.distance = length * (NEAR + FARTHER * count**0.5)
        self.centre = np.array([0.0, 0.0, 0.5 * self.size.height])
        """(3,) where the camera on a plane looks at: from the ground below the middle of the robots [m]."""
        self.glide = GLIDE
        """Share of the way to robots on a plane that the camera makes up in a picture."""
        self.arrows = True
        """Whether velocities are drawn in."""
        self.offsets = np.zeros((count, 3))
        self._follower: Follower | None = None
        if task.terrain is None:
            columns = int(np.ceil(count**0.5))
            grid = np.array([[-(i // columns), i % columns] for i in range(count)], dtype=float)
            self.offsets[:, :2] = SPACING * length * (grid - grid.mean(axis=0))
        else:
            self._follower = Follower(task.terrain.height_map, FOLLOWED_FROM * length)
        self._single = mujoco.MjData(task.physics.model)
        self._lookat: np.ndarray | None = None

    def come_near(self, fill: float, glide: float) -> None:
        """Go so near that the box around a robot in its default pose fills the share `fill` of the picture's width or height,
        and stay with it: make up the share `glide` of the way to it in a picture, also over terrain. No arrows are drawn.
        """
        up = fill * np.tan(np.radians(0.5 * self.model.vis.global_.fovy))
        corners = 0.5 * np.array(self.size.sides) * np.array(list(product((-1.0, 1.0), repeat=3)))
        lookat, distance, _ = frame(corners, (up * self.width / self.height, up), self.view.azimuth, self.view.elevation)
        self.view.distance, self.glide, self.arrows = distance, glide, False
        self.centre = self.centre + lookat
        if self._follower is not None:
            self._follower.distance, self._follower.glide = distance, np.full(3, glide)

    def turn_to(self, first: int) -> None:
        """Draw the robots from number `first` on; the camera is with them at once."""
        if first != self.first:
            self.first, self._lookat = first, None
            if self._follower is not None:
                self._follower.lookat = None

    def picture(self, lines: Sequence[str] = ()) -> np.ndarray:
        """Return (height, width, 3) uint8: the robots now, arrows above them, and lines of text."""
        size = self.task.physics.model.nq
        drawn = slice(self.first, self.first + self.count)
        for i in range(self.count):
            self.task.physics.copy_to(self.first + i, self._single)
            self.data.qpos[i * size : (i + 1) * size] = self._single.qpos
            self.data.qpos[i * size : i * size + 3] += self.offsets[i]
        bases = self.data.qpos.reshape(self.count, size)[:, :3]
        self._point(bases)
        self.update()
        self._shade_feet(None if self.task.terrain is None else self.task.terrain.height_map)
        commands = self.task.commands[drawn, :2].cpu().numpy()
        actual = self.task.base_lin_vel[drawn, :2].cpu().numpy()
        for i in range(self.count if self.arrows else 0):
            matrix = self.data.body(f"{i}/{self.task.robot.file.base}").xmat.reshape(3, 3)
            yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            above = bases[i] + np.array([0.0, 0.0, ABOVE * self.size.longest])
            self._arrow(above, turn @ commands[i], COMMANDED)
            self._arrow(above + np.array([0.0, 0.0, APART * self.size.longest]), turn @ actual[i], ACTUAL)
        return caption(self.render(), lines, (COMMANDED, ACTUAL))

    def _point(self, bases: np.ndarray) -> None:
        """Turn the camera to robots at `bases` (count, 3), world frame [m]."""
        if self._follower is not None:
            self._follower.update(bases[self.followed])
            self._follower.aim(self.view)
            return
        centre = np.array([*bases[:, :2].mean(axis=0), 0.0]) + self.centre
        self._lookat = centre if self._lookat is None else self._lookat + self.glide * (centre - self._lookat)
        self.view.lookat[:] = self._lookat

    def _shade_feet(self, ground: HeightMap | None) -> None:
        """Draw a dark spot on the ground below each foot, in place of shadows: it shows where feet stand, and which ones.
        Without `ground` it is level, at height 0.
        """
        feet = (self.task.feet_pos[self.first : self.first + self.count].cpu().numpy() + self.offsets[:, None]).reshape(-1, 3)
        below = np.zeros(len(feet)) if ground is None else ground.height_at(feet[:, 0], feet[:, 1])
        length = self.size.longest
        for foot, height in zip(feet, below, strict=True):
            radius = SPOT * length * np.clip(1.0 - (foot[2] - height) / (LIFTED * length), 0.3, 1.0)
            self.add_shape(mujoco.mjtGeom.mjGEOM_ELLIPSOID, SHADE, [radius, radius, 0.02], [*foot[:2], height])

    def _arrow(self, start: np.ndarray, velocity: np.ndarray, color: tuple[float, ...]) -> None:
        """Draw an arrow of 0.6 m per m/s."""
        if np.linalg.norm(velocity) < 0.03:
            return
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        geom = self.add_shape(kind, color, [0.0] * 3, [0.0] * 3)
        if geom is not None:
            mujoco.mjv_connector(geom, kind, 0.03, start, start + 0.6 * np.array([*velocity, 0.0]))
