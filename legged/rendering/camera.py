"""Off-screen rendering of MuJoCo models: cameras and their viewpoints, pictures of tasks, and text in pictures."""

import copy
import functools
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from itertools import product
from typing import Any

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from PIL import Image, ImageDraw, ImageFont

from legged.envs import BaseTask, LeggedRobot, RobotTask, is_robot_task, is_velocity_task
from legged.envs.motion_tracking import is_tracking_task
from legged.errors import RunError
from legged.process import headless
from legged.process.headless import HEADLESS, off_screen_library
from legged.rendering.ghost import Ghost
from legged.rendering.scene import display_model
from legged.robots.importing.convert import robot_spec_of
from legged.robots.robot import Robot
from legged.terrain import HeightMap

COLLISION_SHAPES = 3
"""Geom group of the collision shapes, which are not drawn."""
INK = (40, 40, 40)
"""Default colour of text."""
ON_A_PLANE = 130.0, -18.0
"""Azimuth and elevation of the camera if the robots are on a plane [degrees]."""
GLIDE, SMOOTH = 0.1, np.array([0.12, 0.12, 0.05])
"""For each picture, the point that the camera looks at moves towards the robot by this share of the distance: GLIDE on a
plane, SMOOTH (x, y, z) on terrain. Small shares keep the robot's steps from shaking the picture.
"""
CUT = 1.5
"""If a robot on terrain is farther than this from the point that the camera looks at, the camera jumps to the robot [m]."""
FLATTEST, STEEPEST = -22.0, -70.0
"""Limits of the camera's elevation on terrain [degrees]."""
BEHIND, FRONT = 62.0, 118.0
"""Azimuths of the camera at a robot's side on terrain: a little behind the robot, and a little in front of it [degrees]."""
AHEAD, DROP = 3.0, 0.1
"""A robot counts as walking down if the ground at a distance of AHEAD in front of it is lower by more than DROP [m]."""
CLEAR = 0.35
"""Smallest height of the line of sight above the ground, except near the robot [m]."""
COMMANDED = (0.10, 0.75, 0.25, 1.0)
ACTUAL = (0.15, 0.45, 0.95, 1.0)
SHADE = (0.05, 0.05, 0.05, 0.4)
SPACING = 1.82
"""Distance between neighbouring robots in pictures of a plane, in lengths of a robot (1.9 m for ANYmal C)."""
FOLLOWED_FROM = 3.45
"""Distance of the camera from a robot on terrain, in lengths of a robot (3.6 m for ANYmal C)."""
NEAR, FARTHER = 1.92, 1.05
"""The camera's distance on a plane is NEAR + FARTHER * sqrt(number of robots), in lengths of a robot."""
ABOVE, APART = 0.335, 0.086
"""Height of the lower velocity arrow above the base, and of the upper arrow above the lower one, in lengths of a robot."""
ARROW, SLOWEST_SHOWN = 0.6, 0.03
"""Length of a velocity arrow for 1 m/s [m], and smallest velocity that is drawn as an arrow [m/s]."""
SPOT, LIFTED = 0.086, 0.38
"""Radius of the spot below a foot: SPOT * (1 - foot height / LIFTED), at least 0.3 SPOT; all in lengths of a robot."""
ROOT, AWAY = 1, 2.4
"""A ModelCamera follows the body ROOT, the first one after the world, at a distance of AWAY lengths of the model."""
DRAWN = 1000.0
"""Half the side of a drawn ground plane [m]."""
AZIMUTH, ELEVATION = 90.0, -12.0
"""A ModelCamera looks along y, so that x points to the right [degrees]."""


class Camera:
    """Renderer of one model. Its owner sets the poses in `data` and the viewpoint in `view`."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Create the renderer; `width` and `height` [pixels] are at most the model's off-screen size.

        Raises:
            RunError: this machine cannot render.
        """
        self.model, self.width, self.height = model, width, height
        self.data = mujoco.MjData(model)
        self.renderer = make_renderer(model, width, height)
        self.options = mujoco.MjvOption()
        self.options.geomgroup[COLLISION_SHAPES] = 0
        self.view = mujoco.MjvCamera()

    def update(self) -> None:
        """Read `data` and `view`, and remove the shapes that `add_shape` has added."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.renderer.update_scene(self.data, self.view, self.options)

    def render(self) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 of the last `update` and of the shapes added since."""
        return self.renderer.render()

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return the pixel coordinates (N, 2) of world points (N, 3) [m], from the upper left corner. Call `update` first."""
        eyes = self.renderer.scene.camera
        eye, forward, up = (np.mean([getattr(side, name) for side in eyes], axis=0) for name in ("pos", "forward", "up"))
        edge = eyes[0].frustum_top / eyes[0].frustum_near
        across = np.stack([(points - eye) @ np.cross(forward, up), -(points - eye) @ up], axis=1)
        depth = np.maximum((points - eye) @ forward, 0.1)
        return 0.5 * np.array([self.width, self.height]) + 0.5 * self.height / edge * across / depth[:, None]

    def add_shape(self, kind: mujoco.mjtGeom, color: Sequence[float], size: Any, pos: Any) -> mujoco.MjvGeom:
        """Add a shape at `pos` (3,), world frame [m], to the next picture only; return it. `size` (3,) is as in MuJoCo."""
        scene = self.renderer.scene
        geom, rgba = scene.geoms[scene.ngeom], np.array(color, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size, dtype=float), np.array(pos, dtype=float), np.eye(3).ravel(), rgba)
        scene.ngeom += 1
        return geom

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()


def make_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Return a renderer of a model.

    Raises:
        RunError: this machine cannot render.
    """
    if headless.NO_PICTURES:
        raise RunError(f"cannot render here: {headless.NO_PICTURES}")
    library = off_screen_library()
    if sys.platform == "linux" and "MUJOCO_GL" not in os.environ and library is not None and not window_opens():
        # MuJoCo's default, GLFW, cannot open a window here. If a renderer fails, MuJoCo aborts at the creation of the next
        # one. So another library is chosen before the first renderer is created.
        os.environ["MUJOCO_GL"] = library
        gl_context.GLContext = import_module(f"mujoco.{library}").GLContext
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw warns before it fails
            return mujoco.Renderer(model, height, width, max_geom=2 * model.ngeom + 1000)
    except Exception as error:  # each GL library has its own exceptions
        needed = "on a machine without a display, install EGL or OSMesa and set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
        raise RunError(f"cannot render here ({error}); {needed}") from error


@functools.cache
def window_opens() -> bool:
    """Return whether GLFW can open windows. If it cannot, MuJoCo's viewer would wait for ever. A display that answers may
    still refuse windows.
    """
    if HEADLESS:
        return False
    try:
        import glfw
    except ImportError:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opens = bool(glfw.init())
    if opens:
        glfw.terminate()  # the viewer initialises GLFW itself, in another thread
    return opens


# ---- viewpoints --------------------------------------------------------------------------------------------------------


def size_of(robot: Robot) -> np.ndarray:
    """Return the sides (3,) [m] of the axis-aligned box around a robot in its default pose. The box contains all visual and
    collision shapes; ANYmal C's box is 1.04 m long and 0.77 m high.
    """
    return size_of_model(robot_spec_of(robot.model_path, drawn=True).compile(), robot.default_qpos)


def size_of_model(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return the sides (3,) [m] of the axis-aligned box around all shapes, except the world's, of a model at `qpos` (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    own = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE))
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    points = [
        data.geom_xpos[i] + (model.geom_aabb[i, :3] + corners * model.geom_aabb[i, 3:]) @ data.geom_xmat[i].reshape(3, 3).T
        for i in own
    ]
    return np.asarray(np.ptp(np.concatenate(points), axis=0))


def side_by_side(count: int, columns: int) -> np.ndarray:
    """Return points (count, 3) of a horizontal grid with spacing 1 around the origin; rows lie along y, columns along -x."""
    at = np.arange(count)
    grid = np.stack([-(at // columns), at % columns, 0 * at], axis=1).astype(float)
    return grid - grid.mean(axis=0)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the viewing direction (3,), a unit vector in the world frame, of a MuJoCo camera with these angles [degrees]."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def frame(
    points: np.ndarray, reach: Sequence[float], azimuth: float, elevation: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the nearest viewpoint from which all `points` (N, 3), world frame [m], are seen: the point (3,) in the middle of
    the picture, the camera's distance from that point [m], and the width and height (2,) of the points in the picture.

    Lengths in the picture are tangents of viewing angles. `reach` (2,) is the largest allowed distance of a point from the
    middle of the picture, horizontally and vertically.
    """
    forward = direction(azimuth, elevation)
    right = np.array([np.sin(np.radians(azimuth)), -np.cos(np.radians(azimuth)), 0.0])
    axes = np.stack([right, np.cross(right, forward)])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    depth, aside = (points - middle) @ forward, (points - middle) @ axes.T
    # A point at `aside` is within `reach` if |aside - shift| <= reach * (distance + depth) along both axes.
    high, low = ((sign * aside / reach - depth[:, None]).max(axis=0) for sign in (1.0, -1.0))
    distance = float(0.5 * (high + low).max())
    shift = 0.5 * np.asarray(reach) * (high - low)
    seen = (aside - shift) / (distance + depth)[:, None]
    return middle + shift @ axes, distance, np.ptp(seen, axis=0)


class Follower:
    """Controls a camera at the side of a robot. On terrain the camera is behind robots that walk up and in front of robots
    that walk down, so that the faces of steps are visible. It looks down so steeply that no ground hides the robot. Robots
    are assumed to walk along x.
    """

    def __init__(self, view: mujoco.MjvCamera, distance: float, ground: HeightMap | None) -> None:
        """Control the viewpoint `view` at `distance` [m] from the robot. Without `ground`, robots stand on a plane."""
        self.view, self.ground = view, ground
        self.glide: np.ndarray | float = GLIDE if ground is None else SMOOTH
        self.begun = False
        """False makes the next `update` jump to its target."""
        view.distance, (view.azimuth, view.elevation) = distance, ON_A_PLANE

    def update(self, target: np.ndarray) -> None:
        """Move the middle of the picture towards `target` (3,), world frame [m]; called once per picture."""
        way = target - self.view.lookat
        if not self.begun or (self.ground is not None and np.linalg.norm(way) > CUT):
            self.begun = True
            self.view.lookat[:] = target
            if self.ground is not None:
                here, ahead = self.ground.height_at(target[0] + np.array([0.0, AHEAD]), np.full(2, target[1]))
                self.view.azimuth = FRONT if ahead < here - DROP else BEHIND
                self.view.elevation = self._free_elevation(self.ground)
            return
        self.view.lookat[:] += self.glide * way
        if self.ground is not None:
            self.view.elevation += 0.05 * (self._free_elevation(self.ground) - self.view.elevation)

    def _free_elevation(self, ground: HeightMap) -> float:
        """Return the flattest elevation at which no ground is between camera and robot [degrees]."""
        along = np.linspace(0.25, 1.0, 12)[:, None] * self.view.distance
        for elevation in np.arange(FLATTEST, STEEPEST, -2.0):
            x, y, z = (self.view.lookat - along * direction(self.view.azimuth, elevation)).T
            if (z > ground.height_at(x, y) + CLEAR).all():
                return float(elevation)
        return STEEPEST


# ---- tasks -------------------------------------------------------------------------------------------------------------


class RobotsCamera(Camera):
    """A camera for `count` robots of a task: the first ones, or those that `turn_to` selects. On a plane the robots are drawn
    side by side, and the camera follows their middle. On terrain it follows one of them, the robot number `followed`. Arrows
    show the commanded and the actual velocity of robots that follow velocity commands. Ghosts show the references of robots
    that track motions.
    """

    def __init__(self, task: RobotTask, count: int, width: int = 960, height: int = 540) -> None:
        """Build the scene and its renderer.

        Raises:
            RunError: this machine cannot render.
        """
        super().__init__(display_model(task.robot, count, width, height, task.terrain), width, height)
        self.task, self.count = task, count
        self.first, self.followed = 0, 0
        self.sides = size_of(task.robot)
        """(3,) sides of the box around a robot in its default pose [m]."""
        self.length = length = float(self.sides.max())
        self.centre = np.array([0.0, 0.0, 0.5 * self.sides[2]])
        """(3,) point that the camera looks at on a plane, relative to the ground below the middle of the robots [m]."""
        self.arrows = True
        """True if the arrows of velocities are drawn."""
        self.ghost = Ghost(task, self.model) if is_tracking_task(task) else None
        """Ghosts of the robots. None draws no ghosts; a task without references has none."""
        self.ground = None if task.terrain is None else task.terrain.height_map
        if self.ground is None:
            self.offsets = SPACING * length * side_by_side(count, int(np.ceil(count**0.5)))
            distance = length * (NEAR + FARTHER * count**0.5)
        else:
            self.offsets, distance = np.zeros((count, 3)), FOLLOWED_FROM * length
        self.follower = Follower(self.view, distance, self.ground)
        self._single = mujoco.MjData(task.physics.model)

    def come_near(self, fill: float, glide: float) -> None:
        """Move the camera so close that the box around a robot in its default pose fills the share `fill` of the picture's
        width or height. In each later picture, the point that the camera looks at moves towards the robot by the share
        `glide` of the distance.
        """
        up = fill * np.tan(np.radians(0.5 * self.model.vis.global_.fovy))
        corners = 0.5 * self.sides * np.array(list(product((-1.0, 1.0), repeat=3)))
        lookat, self.view.distance, _ = frame(
            corners, (up * self.width / self.height, up), self.view.azimuth, self.view.elevation
        )
        self.follower.glide = glide
        self.centre = self.centre + lookat

    def turn_to(self, first: int) -> None:
        """Draw the robots from number `first` on; the camera jumps to them at once."""
        if first != self.first:
            self.first, self.follower.begun = first, False

    def picture(self, lines: Sequence[str] = ()) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of the robots in their present state, with lines of text."""
        size = self.task.physics.model.nq
        for i in range(self.count):
            self.task.physics.copy_to(self.first + i, self._single)
            self.data.qpos[i * size : (i + 1) * size] = self._single.qpos
            self.data.qpos[i * size : i * size + 3] += self.offsets[i]
        bases = self.data.qpos.reshape(self.count, size)[:, :3]
        middle = np.array([*bases[:, :2].mean(axis=0), 0.0]) + self.centre
        self.follower.update(middle if self.ground is None else bases[self.followed])
        self.update()
        self._shade_feet()
        if self.ghost is not None:
            self.ghost.draw(self.renderer.scene, self.options, self.first, self.offsets)
        self.annotate(bases)
        return caption(self.render(), lines, (COMMANDED, ACTUAL))

    def annotate(self, bases: np.ndarray) -> None:
        """Hook: add shapes to the picture of robots whose bases are at `bases` (count, 3) [m]: the arrows of velocities."""
        if self.arrows and is_velocity_task(self.task):
            self._draw_velocities(self.task, bases)

    def _draw_velocities(self, task: LeggedRobot, bases: np.ndarray) -> None:
        """Draw two arrows above each of `bases` (count, 3) [m]: the commanded velocity, and above it the actual one."""
        drawn = slice(self.first, self.first + self.count)
        commands = task.commands[drawn, :2].cpu().numpy()
        actual = task.base_lin_vel[drawn, :2].cpu().numpy()
        for i in range(self.count):
            matrix = self.data.body(f"{i}/{self.task.robot.file.base}").xmat.reshape(3, 3)
            yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            above = bases[i] + np.array([0.0, 0.0, ABOVE * self.length])
            self._arrow(above, turn @ commands[i], COMMANDED)
            self._arrow(above + np.array([0.0, 0.0, APART * self.length]), turn @ actual[i], ACTUAL)

    def _shade_feet(self) -> None:
        """Draw a dark spot on the ground below each foot instead of a shadow."""
        feet = (self.task.feet_pos[self.first : self.first + self.count].cpu().numpy() + self.offsets[:, None]).reshape(-1, 3)
        below = np.zeros(len(feet)) if self.ground is None else self.ground.height_at(feet[:, 0], feet[:, 1])
        for foot, height in zip(feet, below, strict=True):
            radius = SPOT * self.length * np.clip(1.0 - (foot[2] - height) / (LIFTED * self.length), 0.3, 1.0)
            self.add_shape(mujoco.mjtGeom.mjGEOM_ELLIPSOID, SHADE, [radius, radius, 0.02], [*foot[:2], height])

    def _arrow(self, start: np.ndarray, velocity: np.ndarray, color: tuple[float, ...]) -> None:
        if np.linalg.norm(velocity) < SLOWEST_SHOWN:
            return
        kind, end = mujoco.mjtGeom.mjGEOM_ARROW, start + ARROW * np.array([*velocity, 0.0])
        mujoco.mjv_connector(self.add_shape(kind, color, np.zeros(3), start), kind, 0.03, start, end)


class ModelCamera(Camera):
    """A camera for one environment of a task. It follows the centre of mass of the root body's subtree."""

    def __init__(self, task: BaseTask, width: int = 960, height: int = 540) -> None:
        """Build the scene and its renderer.

        Raises:
            RunError: this machine cannot render.
        """
        super().__init__(drawn_model(task, width, height), width, height)
        self.task, self.followed = task, 0
        follow_root(self.view, self.model)

    def turn_to(self, followed: int) -> None:
        """Show the environment number `followed` in the next pictures."""
        self.followed = followed

    def picture(self, lines: Sequence[str] = ()) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of the environment in its present state, with lines of text."""
        self.task.physics.copy_to(self.followed, self.data)
        self.update()
        return caption(self.render(), lines)


def drawn_model(task: BaseTask, width: int, height: int) -> mujoco.MjModel:
    """Return a copy of a task's model for pictures of `width` x `height` [pixels], without shadows and with wide planes."""
    model = copy.deepcopy(task.physics.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0  # 0 makes rendering without a GPU ten times faster
    # Planes are infinite in the simulation. They are drawn as large finite ones, with textures of the same scale, because
    # MuJoCo shifts an infinite plane with the camera, so that two pictures of the same state differ.
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        half, material = model.geom_size[plane, :2], int(model.geom_matid[plane])
        if material >= 0 and (half > 0.0).all() and not model.mat_texuniform[material]:
            model.mat_texrepeat[material] /= 2.0 * half
            model.mat_texuniform[material] = True  # texrepeat now counts per metre
        model.geom_size[plane, :2] = DRAWN
    return model


def follow_root(view: mujoco.MjvCamera, model: mujoco.MjModel) -> None:
    """Make a camera follow the root body from the side."""
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, ROOT
    view.distance = AWAY * float(size_of_model(model, model.qpos0).max())
    view.azimuth, view.elevation = AZIMUTH, ELEVATION


def camera_of(task: BaseTask, count: int = 1, width: int = 960, height: int = 540) -> ModelCamera | RobotsCamera:
    """Return a camera for pictures of `width` x `height` [pixels]. In a task with a robot it draws the first `count` robots.

    Raises:
        RunError: this machine cannot render.
    """
    if is_robot_task(task):
        return RobotsCamera(task, count, width, height)
    return ModelCamera(task, width, height)


# ---- text --------------------------------------------------------------------------------------------------------------


def caption(picture: np.ndarray, lines: Sequence[str], colors: Sequence[Sequence[float]] = ()) -> np.ndarray:
    """Return a picture (height, width, 3) uint8 with lines of text in its upper left corner. Line i has a darker version of
    the colour `colors[i]` (red, green, blue, 0 to 1). Further lines are dark grey.
    """
    if not lines:
        return picture
    inks = [tuple(int(255 * value * 0.8) for value in color[:3]) for color in colors]
    font, height = ImageFont.load_default(size=picture.shape[0] // 30), picture.shape[0] // 22
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    draw.rectangle((0, 0, picture.shape[1] * 0.46, height * len(lines) + 12), fill=(255, 255, 255, 170))
    for i, line in enumerate(lines):
        draw.text((10, 6 + i * height), line, fill=inks[i] if i < len(inks) else INK, font=font)
    return np.asarray(image)


def labels(picture: np.ndarray, texts: Sequence[str], at: np.ndarray) -> np.ndarray:
    """Return a picture (height, width, 3) uint8 with texts centred at the pixels `at` (N, 2)."""
    font = ImageFont.load_default(size=picture.shape[0] / 42)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    for text, (x, y) in zip(texts, at, strict=True):
        box = draw.textbbox((x, y), text, font=font, anchor="mm")
        draw.rounded_rectangle((box[0] - 8, box[1] - 5, box[2] + 8, box[3] + 5), radius=6, fill=(255, 255, 255, 215))
        draw.text((x, y), text, fill=INK, font=font, anchor="mm")
    return np.asarray(image)
