"""A MuJoCo scene as a camera sees it."""

from collections.abc import Sequence

import mujoco
import numpy as np

from legged.rendering.scene import make_renderer

COLLISION_SHAPES = 3
"""Group of the shapes that are touched and not seen."""


class Camera:
    """Pictures of one model. Who owns it poses `data` and turns `view`."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, instead: str = "") -> None:
        """Make the renderer; `width` and `height` [pixels] are at most the model's off-screen size.

        Raises:
            RunError: nothing can be rendered here; `instead` is what the user might do then.
        """
        self.model, self.width, self.height = model, width, height
        self.data = mujoco.MjData(model)
        self.renderer = make_renderer(model, width, height, instead)
        self.options = mujoco.MjvOption()
        self.options.geomgroup[COLLISION_SHAPES] = 0
        self.view = mujoco.MjvCamera()

    def update(self) -> None:
        """Take in how `data` stands and where `view` looks from; shapes of earlier pictures alone are gone."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.renderer.update_scene(self.data, self.view, self.options)

    def render(self) -> np.ndarray:
        """Return (height, width, 3) uint8: what was taken in, and what was added to it."""
        return self.renderer.render()

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return (N, 2) where world points (N, 3) [m] are in the picture, from its upper left corner; after `update`."""
        eyes = self.renderer.scene.camera
        eye, forward, up = (np.mean([getattr(side, name) for side in eyes], axis=0) for name in ("pos", "forward", "up"))
        edge = eyes[0].frustum_top / eyes[0].frustum_near
        across = np.stack([(points - eye) @ np.cross(forward, up), -(points - eye) @ up], axis=1)
        depth = np.maximum((points - eye) @ forward, 0.1)
        return 0.5 * np.array([self.width, self.height]) + 0.5 * self.height / edge * across / depth[:, None]

    def add_shape(
        self, kind: mujoco.mjtGeom, color: Sequence[float], size: Sequence[float], pos: Sequence[float]
    ) -> mujoco.MjvGeom | None:
        """Add a shape to this picture alone, upright at `pos`; None where there is no room."""
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
