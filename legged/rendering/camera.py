"""Pictures of several robots in one scene, with commanded and actual velocity drawn in."""

from collections.abc import Sequence

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from legged.envs import LeggedRobot
from legged.rendering.follower import Follower
from legged.rendering.scene import display_model, make_renderer
from legged.rendering.size import size_of
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
SPOT, LIFTED = 0.086, 0.38
"""Radius of the spot below a foot on the ground, and height at which it is smallest, in lengths of a robot."""


class Camera:
    """Draws the first `count` robots of a task: on a plane side by side, from a camera that follows them all; on terrain
    where they are, from one that follows the robot `followed`.
    """

    def __init__(self, task: LeggedRobot, count: int, width: int = 960, height: int = 540) -> None:
        """Raises RunError where nothing can be rendered."""
        self.task, self.count = task, count
        self.followed = 0
        self.model = display_model(task.robot, count, width, height, task.terrain)
        self.data = mujoco.MjData(self.model)
        self.renderer = make_renderer(self.model, width, height, ", or play with --no-video")
        self.options = mujoco.MjvOption()
        self.options.geomgroup[3] = 0  # collision shapes
        self.view = mujoco.MjvCamera()
        self.size = size_of(task.robot)
        length = self.size.longest
        self.view.azimuth, self.view.elevation = 130.0, -18.0
        self.view.distance = length * (NEAR + FARTHER * count**0.5)
        self.offsets = np.zeros((count, 3))
        self._follower: Follower | None = None
        if task.terrain is None:
            columns = int(np.ceil(count**0.5))
            grid = np.array([[-(i // columns), i % columns] for i in range(count)], dtype=float)
            self.offsets[:, :2] = SPACING * length * (grid - grid.mean(axis=0))
        else:
            self._follower = Follower(task.terrain.height_map, FOLLOWED_FROM * length)
        self._single = mujoco.MjData(task.physics.model)  # type: ignore[attr-defined]
        self._lookat: np.ndarray | None = None

    def picture(self, caption: Sequence[str] = ()) -> np.ndarray:
        """(height, width, 3) uint8: the robots now, arrows above them, and lines of text."""
        size = 7 + self.task.num_actions
        for i in range(self.count):
            self.task.physics.copy_to(i, self._single)
            self.data.qpos[i * size : (i + 1) * size] = self._single.qpos
            self.data.qpos[i * size : i * size + 3] += self.offsets[i]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        bases = self.data.qpos.reshape(self.count, size)[:, :3]
        self._point(bases)
        self.renderer.update_scene(self.data, self.view, self.options)
        self._shade_feet(None if self.task.terrain is None else self.task.terrain.height_map)
        commands = self.task.commands[: self.count, :2].cpu().numpy()
        actual = self.task.base_lin_vel[: self.count, :2].cpu().numpy()
        for i in range(self.count):
            matrix = self.data.body(f"{i}/{self.task.robot.file.base}").xmat.reshape(3, 3)
            yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            above = bases[i] + np.array([0.0, 0.0, ABOVE * self.size.longest])
            self._arrow(above, turn @ commands[i], COMMANDED)
            self._arrow(above + np.array([0.0, 0.0, APART * self.size.longest]), turn @ actual[i], ACTUAL)
        return _write_on(self.renderer.render(), caption)

    def _point(self, bases: np.ndarray) -> None:
        """Turn the camera to robots at `bases` (count, 3), world frame [m]."""
        if self._follower is not None:
            self._follower.update(bases[self.followed])
            self._follower.aim(self.view)
            return
        centre = np.array([*bases[:, :2].mean(axis=0), 0.5 * self.size.height])
        self._lookat = centre if self._lookat is None else 0.9 * self._lookat + 0.1 * centre  # no shaking
        self.view.lookat[:] = self._lookat

    def _shade_feet(self, ground: HeightMap | None) -> None:
        """A dark spot on the ground below each foot, in place of shadows: it shows where feet stand, and which ones. Without
        `ground` it is level, at height 0.
        """
        feet = (self.task.feet_pos[: self.count].cpu().numpy() + self.offsets[:, None]).reshape(-1, 3)
        below = np.zeros(len(feet)) if ground is None else ground.height_at(feet[:, 0], feet[:, 1])
        length = self.size.longest
        for foot, height in zip(feet, below, strict=True):
            radius = SPOT * length * np.clip(1.0 - (foot[2] - height) / (LIFTED * length), 0.3, 1.0)
            self._decorate(mujoco.mjtGeom.mjGEOM_ELLIPSOID, SHADE, [radius, radius, 0.02], [*foot[:2], height])

    def _decorate(
        self, kind: mujoco.mjtGeom, colour: Sequence[float], size: Sequence[float], pos: Sequence[float]
    ) -> mujoco.MjvGeom | None:
        """Add a shape to the picture alone, upright at `pos`; None where there is no room."""
        scene = self.renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return None
        geom = scene.geoms[scene.ngeom]
        rgba = np.array(colour, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size, dtype=float), np.array(pos, dtype=float), np.eye(3).ravel(), rgba)
        scene.ngeom += 1
        return geom

    def _arrow(self, start: np.ndarray, velocity: np.ndarray, colour: tuple[float, ...]) -> None:
        """An arrow of 0.6 m per m/s."""
        if np.linalg.norm(velocity) < 0.03:
            return
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        geom = self._decorate(kind, colour, [0.0] * 3, [0.0] * 3)
        if geom is not None:
            mujoco.mjv_connector(geom, kind, 0.03, start, start + 0.6 * np.array([*velocity, 0.0]))

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()


def _write_on(picture: np.ndarray, lines: Sequence[str]) -> np.ndarray:
    """Lines of text in the upper left corner, the first two in the colours of the arrows."""
    if not lines:
        return picture
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    font = ImageFont.load_default(size=picture.shape[0] // 30)
    height = picture.shape[0] // 22
    draw.rectangle((0, 0, picture.shape[1] * 0.46, height * len(lines) + 12), fill=(255, 255, 255, 170))
    colours = [tuple(int(255 * c * 0.8) for c in colour[:3]) for colour in (COMMANDED, ACTUAL)] + [(40, 40, 40)] * 8
    for i, line in enumerate(lines):
        draw.text((10, 6 + i * height), line, fill=colours[i], font=font)
    return np.asarray(image)
