"""Rendering of one MuJoCo model off screen, and text in the pictures."""

import functools
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from PIL import Image, ImageDraw, ImageFont

from legged.errors import RunError
from legged.process import headless
from legged.process.headless import HEADLESS, off_screen_library

COLLISION_SHAPES = 3
"""Geom group of the collision shapes, which are not drawn."""
INK = (40, 40, 40)
"""Default colour of text."""


class Camera:
    """Renderer of one model. Its owner sets the poses in `data` and the viewpoint in `view`."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, instead: str = "") -> None:
        """Create the renderer; `width` and `height` [pixels] are at most the model's off-screen size.

        Raises:
            RunError: this machine cannot render; `instead` ends the message with an alternative.
        """
        self.model, self.width, self.height = model, width, height
        self.data = mujoco.MjData(model)
        self.renderer = make_renderer(model, width, height, instead)
        self.options = mujoco.MjvOption()
        self.options.geomgroup[COLLISION_SHAPES] = 0
        self.view = mujoco.MjvCamera()

    def update(self) -> None:
        """Read `data` and `view`; removes the shapes that `add_shape` has added."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.renderer.update_scene(self.data, self.view, self.options)

    def render(self) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 of the last `update` and of the shapes added since."""
        return self.renderer.render()

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of world points (N, 3) [m], from the upper left corner; valid after `update`."""
        eyes = self.renderer.scene.camera
        eye, forward, up = (np.mean([getattr(side, name) for side in eyes], axis=0) for name in ("pos", "forward", "up"))
        edge = eyes[0].frustum_top / eyes[0].frustum_near
        across = np.stack([(points - eye) @ np.cross(forward, up), -(points - eye) @ up], axis=1)
        depth = np.maximum((points - eye) @ forward, 0.1)
        return 0.5 * np.array([self.width, self.height]) + 0.5 * self.height / edge * across / depth[:, None]

    def add_shape(
        self, kind: mujoco.mjtGeom, color: Sequence[float], size: Sequence[float], pos: Sequence[float]
    ) -> mujoco.MjvGeom | None:
        """Add an upright shape at `pos` to the next picture only; return None if the scene is full."""
        scene = self.renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return None
        geom = scene.geoms[scene.ngeom]
        rgba = np.array(color, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size, dtype=float), np.array(pos, dtype=float), np.eye(3).ravel(), rgba)
        scene.ngeom += 1
        return geom

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()


def make_renderer(model: mujoco.MjModel, width: int, height: int, instead: str = "") -> mujoco.Renderer:
    """Return a renderer of a model.

    Raises:
        RunError: this machine cannot render; `instead` ends the message with an alternative.
    """
    if headless.NO_PICTURES:
        raise RunError(f"cannot render here: {headless.NO_PICTURES}{instead}")
    _draw_without_window()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw warns before it fails
            return mujoco.Renderer(model, height, width, max_geom=model.ngeom + 1000)
    except Exception as error:  # each GL library has its own exceptions
        raise RunError(
            f"cannot render here ({error}); without a display MUJOCO_GL=egl or MUJOCO_GL=osmesa and their libraries are"
            f" needed{instead}"
        ) from error


@functools.cache
def window_opens() -> bool:
    """Return whether GLFW can open windows. A display may accept connections and refuse windows; MuJoCo's viewer would then
    wait for ever.
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
        glfw.terminate()  # the viewer initialises GLFW in its own thread
    return opens


def _draw_without_window() -> None:
    """Make MuJoCo render off screen where its default, GLFW, cannot open a window. Must precede the first renderer: MuJoCo
    aborts when one is created after a failure.
    """
    library = off_screen_library()
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ or library is None or window_opens():
        return
    os.environ["MUJOCO_GL"] = library
    gl_context.GLContext = import_module(f"mujoco.{library}").GLContext


def caption(picture: np.ndarray, lines: Sequence[str], colors: Sequence[Sequence[float]] = ()) -> np.ndarray:
    """Return a picture (height, width, 3) uint8 with lines of text in its upper left corner; the first lines have slightly
    darker versions of `colors` (red, green, blue, 0 to 1).
    """
    if not lines:
        return picture
    inks = [tuple(int(255 * value * 0.8) for value in color[:3]) for color in colors]
    font = ImageFont.load_default(size=picture.shape[0] // 30)
    height = picture.shape[0] // 22
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
