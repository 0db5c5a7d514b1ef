"""Pictures of a task of any kind: the world as its model describes it, seen from beside its root body."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from legged.envs import BaseTask
from legged.rendering.camera import Camera
from legged.rendering.size import size_of_model
from legged.rendering.text import caption

ROOT = 1
"""The body that is followed: the first one after the world."""
AWAY = 2.4
"""Distance of the camera, in lengths of what it follows."""
DRAWN = 1000.0
"""Half the side of the ground that is drawn [m]."""
AZIMUTH, ELEVATION = 90.0, -12.0
"""It looks along y, so that x goes to the right [degrees]."""


class ModelCamera(Camera):
    """Draws one environment of a task, from a camera that follows the centre of mass of its root body and all that hangs on
    it.
    """

    def __init__(self, task: BaseTask, width: int = 960, height: int = 540) -> None:
        """Build the scene and its renderer.

        Raises:
            RunError: nothing can be rendered.
        """
        super().__init__(drawn_model(task, width, height), width, height, ", or play with --no-video")
        self.task = task
        self.followed = 0
        follow_root(self.view, self.model)

    def picture(self, lines: Sequence[str] = ()) -> np.ndarray:
        """Return (height, width, 3) uint8: the environment `followed` now, and lines of text."""
        self.task.physics.copy_to(self.followed, self.data)
        self.update()
        return caption(self.render(), lines)


def drawn_model(task: BaseTask, width: int, height: int) -> mujoco.MjModel:
    """Return a copy of the model that a task simulates, for pictures of that size [pixels], drawn as fast as can be."""
    model = copy.deepcopy(task.physics.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0  # ten times faster without a GPU
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        draw_far(model, int(plane))
    return model


def draw_far(model: mujoco.MjModel, plane: int) -> None:
    """Let a plane, which to physics is infinite anyway, be drawn as far as anybody runs. Its texture keeps its scale. MuJoCo
    draws endless planes too, but shifts them with the camera, so that two pictures of one thing differ.
    """
    half, material = model.geom_size[plane, :2], int(model.geom_matid[plane])
    if material >= 0 and (half > 0.0).all() and not model.mat_texuniform[material]:
        model.mat_texrepeat[material] /= 2.0 * half
        model.mat_texuniform[material] = True  # so many a metre, not so many a plane
    model.geom_size[plane, :2] = DRAWN


def follow_root(view: mujoco.MjvCamera, model: mujoco.MjModel) -> None:
    """Let a camera follow the root body from the side."""
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, ROOT
    view.distance = AWAY * size_of_model(model, model.qpos0).longest
    view.azimuth, view.elevation = AZIMUTH, ELEVATION
