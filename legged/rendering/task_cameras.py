"""Cameras for tasks: legged robots in a scene of their own, other tasks in the world of their model."""

import copy
from collections.abc import Sequence
from itertools import product

import mujoco
import numpy as np

from legged.envs import BaseTask, LeggedRobot
from legged.rendering.camera import Camera, caption
from legged.rendering.framing import Follower, frame, side_by_side, size_of, size_of_model
from legged.rendering.scene import display_model
from legged.terrain import HeightMap

COMMANDED = (0.10, 0.75, 0.25, 1.0)
ACTUAL = (0.15, 0.45, 0.95, 1.0)
SHADE = (0.05, 0.05, 0.05, 0.4)
SPACING = 1.82
"""Distance between neighbours on a plane, in lengths of a robot: 1.9 m for ANYmal C."""
FOLLOWED_FROM = 3.45
"""Distance of the camera from the robot that it follows over terrain, in lengths of a robot: 3.6 m for ANYmal C."""
NEAR, FARTHER = 1.92, 1.05
"""Distance of the camera on a plane is NEAR + FARTHER * sqrt(number of robots), in lengths of a robot."""
ABOVE, APART = 0.335, 0.086
"""Height of the lower arrow above the base, and of the upper arrow above the lower one, in lengths of a robot."""
GLIDE = 0.1
"""Share of the distance to the robots that the camera on a plane covers per picture; small so that steps do not shake it."""
SPOT, LIFTED = 0.086, 0.38
"""Radius of the spot below a foot on the ground, and foot height at which the spot is smallest, in lengths of a robot."""
ROOT = 1
"""Body that a ModelCamera follows: the first one after the world."""
AWAY = 2.4
"""Distance of a ModelCamera, in lengths of the model."""
DRAWN = 1000.0
"""Half the side of a drawn ground plane [m]."""
AZIMUTH, ELEVATION = 90.0, -12.0
"""A ModelCamera looks along y, so that x points to the right [degrees]."""


class RobotsCamera(Camera):
    """A camera for `count` robots of a task, the first ones unless `turn_to` selects others. On a plane the robots stand side
    by side and the camera follows their middle; on terrain it follows the robot number `followed` of them. Arrows show
    the commanded and the actual velocity.
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
            RunError: this machine cannot render; `instead` ends the message with an alternative.
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
        """(3,) point in the middle of a picture on a plane, relative to the ground below the middle of the robots [m]."""
        self.glide = GLIDE
        """Share of the distance to robots on a plane that the camera covers per picture."""
        self.arrows = True
        """Draw the velocities."""
        self.offsets = np.zeros((count, 3))
        self._follower: Follower | None = None
        if task.terrain is None:
            self.offsets = SPACING * length * side_by_side(count, int(np.ceil(count**0.5)))
        else:
            self._follower = Follower(task.terrain.height_map, FOLLOWED_FROM * length)
        self._single = mujoco.MjData(task.physics.model)
        self._lookat: np.ndarray | None = None

    def come_near(self, fill: float, glide: float) -> None:
        """Move so close that the box around a robot in its default pose fills the share `fill` of the picture's width or
        height. From then on the camera covers the share `glide` of the distance to the robot per picture. Hides the arrows.
        """
        up = fill * np.tan(np.radians(0.5 * self.model.vis.global_.fovy))
        corners = 0.5 * np.array(self.size.sides) * np.array(list(product((-1.0, 1.0), repeat=3)))
        lookat, distance, _ = frame(corners, (up * self.width / self.height, up), self.view.azimuth, self.view.elevation)
        self.view.distance, self.glide, self.arrows = distance, glide, False
        self.centre = self.centre + lookat
        if self._follower is not None:
            self._follower.distance, self._follower.glide = distance, np.full(3, glide)

    def turn_to(self, first: int) -> None:
        """Draw the robots from number `first` on; the camera jumps to them at once."""
        if first != self.first:
            self.first, self._lookat = first, None
            if self._follower is not None:
                self._follower.lookat = None

    def picture(self, lines: Sequence[str] = ()) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of the robots in their present state, with lines of text."""
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
        """Point the camera at robots at `bases` (count, 3), world frame [m]."""
        if self._follower is not None:
            self._follower.update(bases[self.followed])
            self._follower.aim(self.view)
            return
        centre = np.array([*bases[:, :2].mean(axis=0), 0.0]) + self.centre
        self._lookat = centre if self._lookat is None else self._lookat + self.glide * (centre - self._lookat)
        self.view.lookat[:] = self._lookat

    def _shade_feet(self, ground: HeightMap | None) -> None:
        """Draw a dark spot on the ground below each foot instead of a shadow. Without `ground` the spots are at height 0."""
        feet = (self.task.feet_pos[self.first : self.first + self.count].cpu().numpy() + self.offsets[:, None]).reshape(-1, 3)
        below = np.zeros(len(feet)) if ground is None else ground.height_at(feet[:, 0], feet[:, 1])
        length = self.size.longest
        for foot, height in zip(feet, below, strict=True):
            radius = SPOT * length * np.clip(1.0 - (foot[2] - height) / (LIFTED * length), 0.3, 1.0)
            self.add_shape(mujoco.mjtGeom.mjGEOM_ELLIPSOID, SHADE, [radius, radius, 0.02], [*foot[:2], height])

    def _arrow(self, start: np.ndarray, velocity: np.ndarray, color: tuple[float, ...]) -> None:
        """Draw a velocity [m/s] as an arrow of 0.6 m per m/s."""
        if np.linalg.norm(velocity) < 0.03:
            return
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        geom = self.add_shape(kind, color, [0.0] * 3, [0.0] * 3)
        if geom is not None:
            mujoco.mjv_connector(geom, kind, 0.03, start, start + 0.6 * np.array([*velocity, 0.0]))


class ModelCamera(Camera):
    """A camera for one environment of a task, which follows the centre of mass of its root body's subtree."""

    def __init__(self, task: BaseTask, width: int = 960, height: int = 540) -> None:
        """Build the scene and its renderer.

        Raises:
            RunError: this machine cannot render.
        """
        super().__init__(drawn_model(task, width, height), width, height, ", or play with --no-video")
        self.task = task
        self.followed = 0
        follow_root(self.view, self.model)

    def turn_to(self, followed: int) -> None:
        """Draw the environment `followed`."""
        self.followed = followed

    def picture(self, lines: Sequence[str] = ()) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of the environment in its present state, with lines of text."""
        self.task.physics.copy_to(self.followed, self.data)
        self.update()
        return caption(self.render(), lines)


def drawn_model(task: BaseTask, width: int, height: int) -> mujoco.MjModel:
    """Return a copy of a task's model for pictures of that size [pixels], with few effects and wide ground planes."""
    model = copy.deepcopy(task.physics.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0  # ten times faster without a GPU
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        draw_far(model, int(plane))
    return model


def draw_far(model: mujoco.MjModel, plane: int) -> None:
    """Make a plane, which is infinite in the simulation, large enough in pictures; its texture keeps its scale. MuJoCo also
    draws infinite planes, but shifts them with the camera, so that two pictures of one state differ.
    """
    half, material = model.geom_size[plane, :2], int(model.geom_matid[plane])
    if material >= 0 and (half > 0.0).all() and not model.mat_texuniform[material]:
        model.mat_texrepeat[material] /= 2.0 * half
        model.mat_texuniform[material] = True  # texrepeat now counts per metre
    model.geom_size[plane, :2] = DRAWN


def follow_root(view: mujoco.MjvCamera, model: mujoco.MjModel) -> None:
    """Make a camera follow the root body from the side."""
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, ROOT
    view.distance = AWAY * size_of_model(model, model.qpos0).longest
    view.azimuth, view.elevation = AZIMUTH, ELEVATION


def camera_of(task: BaseTask, count: int = 1, width: int = 960, height: int = 540) -> ModelCamera | RobotsCamera:
    """Return a camera for a task, with pictures of that size [pixels]; of legged robots it draws the first `count`.

    Raises:
        RunError: this machine cannot render.
    """
    if isinstance(task, LeggedRobot):
        return RobotsCamera(task, count, width, height)
    return ModelCamera(task, width, height)
