"""Pictures of several robots in one scene, with commanded and actual velocity drawn in."""

from collections.abc import Sequence

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from legged.config import ConfigError
from legged.envs import LeggedRobot
from legged.robot import Robot

COMMANDED = (0.10, 0.75, 0.25, 1.0)
ACTUAL = (0.15, 0.45, 0.95, 1.0)
SPACING = 1.9
"""Distance between neighbours [m]."""


def add_sky(scene: mujoco.MjSpec) -> None:
    """A pale blue sky, white at the horizon."""
    scene.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.76, 0.90],
        rgb2=[0.94, 0.96, 0.98],
        width=256,
        height=1536,
    )


def display_model(robot: Robot, count: int, width: int, height: int) -> mujoco.MjModel:
    """`count` copies of the robot over one checkered floor under a sky; for drawing, not for simulating."""
    scene = mujoco.MjSpec()
    scene.visual.global_.offwidth, scene.visual.global_.offheight = width, height
    scene.visual.quality.shadowsize = scene.visual.quality.offsamples = 0  # ten times faster without a GPU
    scene.visual.headlight.ambient, scene.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    scene.visual.map.zfar = 60
    scene.stat.extent, scene.stat.center = 4.0, [0, 0, 0.4]
    add_sky(scene)
    scene.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.80, 0.82, 0.84],
        rgb2=[0.70, 0.73, 0.76],
        width=512,
        height=512,
    )
    ground = scene.add_material(name="ground", texrepeat=[1, 1], texuniform=True)
    ground.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="ground")
    scene.worldbody.add_light(
        pos=[0, 0, 20], dir=[-0.3, 0.35, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[0.5] * 3
    )
    for i in range(count):
        frame = scene.worldbody.add_frame()
        scene.attach(mujoco.MjSpec.from_file(str(robot.model_path)), prefix=f"{i}/", frame=frame)
    return scene.compile()


class Camera:
    """Draws the first `count` robots of a task, side by side on one floor, from a camera that follows them."""

    def __init__(self, task: LeggedRobot, count: int, width: int = 960, height: int = 540) -> None:
        """Raises ConfigError where nothing can be rendered."""
        self.task, self.count = task, count
        self.model = display_model(task.robot, count, width, height)
        self.data = mujoco.MjData(self.model)
        try:
            self.renderer = mujoco.Renderer(self.model, height, width)
        except Exception as error:  # each GL back-end fails in its own way
            raise ConfigError(
                f"cannot render here ({error}); without a display MUJOCO_GL=egl or MUJOCO_GL=osmesa and their"
                " libraries are needed, or play with --no-video"
            ) from error
        self.options = mujoco.MjvOption()
        self.options.geomgroup[3] = 0  # collision shapes
        self.view = mujoco.MjvCamera()
        self.view.azimuth, self.view.elevation, self.view.distance = 130.0, -18.0, 2.0 + 1.1 * count**0.5
        columns = int(np.ceil(count**0.5))
        grid = np.array([[-(i // columns), i % columns] for i in range(count)], dtype=float)
        self.offsets = np.zeros((count, 3))
        self.offsets[:, :2] = SPACING * (grid - grid.mean(axis=0))
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
        centre = np.array([*bases[:, :2].mean(axis=0), 0.4])
        self._lookat = centre if self._lookat is None else 0.9 * self._lookat + 0.1 * centre  # no shaking
        self.view.lookat[:] = self._lookat
        self.renderer.update_scene(self.data, self.view, self.options)
        commands = self.task.commands[: self.count, :2].cpu().numpy()
        actual = self.task.base_lin_vel[: self.count, :2].cpu().numpy()
        for i in range(self.count):
            matrix = self.data.body(f"{i}/{self.task.robot.file.base}").xmat.reshape(3, 3)
            yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            above = bases[i] + np.array([0.0, 0.0, 0.35])
            self._arrow(above, turn @ commands[i], COMMANDED)
            self._arrow(above + np.array([0.0, 0.0, 0.09]), turn @ actual[i], ACTUAL)
        return _write_on(self.renderer.render(), caption)

    def _arrow(self, start: np.ndarray, velocity: np.ndarray, colour: tuple[float, ...]) -> None:
        """An arrow of 0.6 m per m/s."""
        scene = self.renderer.scene
        if np.linalg.norm(velocity) < 0.03 or scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        rgba = np.array(colour, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        end = start + 0.6 * np.array([*velocity, 0.0])
        mujoco.mjv_connector(geom, kind, 0.03, start, end)
        scene.ngeom += 1

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
