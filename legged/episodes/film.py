"""Pictures of a recorded episode. Its states are written into a task with one robot and drawn like those of play; without a
renderer, the bodies' positions are drawn as a stick figure.
"""

import base64
import io
from typing import Any

import mujoco
import numpy as np
import torch
from PIL import Image

from legged.config import TaskConfig, override
from legged.envs import BaseTask, LeggedRobot
from legged.episodes.rollout import ground_of
from legged.episodes.stored import Episodes
from legged.errors import ConfigError, RunError
from legged.registry import make_task
from legged.rendering import RobotsCamera, camera_of

WIDTH, HEIGHT = 640, 360
"""Size of a picture [pixels]."""
FPS, MOST_PICTURES = 25.0, 400
"""Pictures per second, and the largest number of pictures of an episode; longer episodes have fewer per second."""
FILL, GLIDE = 0.5, 0.3
"""Share of the picture that a robot fills, and share of the distance to it that the camera moves in a picture."""
QUALITIES = (80, 70, 60, 50, 40, 30, 20, 15, 10)
"""Qualities of JPEG; the first whose pictures together fit into BUDGET_MB is taken."""
BUDGET_MB = 3.0
"""Room for the pictures of a page [MB]; base64 adds a third."""


class Projector:
    """Renderer of recorded episodes. The task of the episodes is built once, with one robot in the C engine."""

    def __init__(self, episodes: Episodes, cfg: TaskConfig) -> None:
        """Build the task that `cfg` describes, on the ground of the episodes.

        Raises:
            ConfigError: the task no longer exists, or its model has changed.
        """
        self.episodes = episodes
        nominal = cfg.trained()
        alone = [("env.num_envs", 1), ("sim.physics", "mujoco"), ("sim.solver", "mujoco"), ("sim.threads", 1)]
        terrain = ground_of(cfg, episodes.about.get("ground"))
        self.task: BaseTask = make_task(override(nominal, alone), "cpu", False, terrain)
        model = self.task.physics.model
        for name, width in (("qpos", model.nq), ("qvel", model.nv)):
            if episodes[name].shape[1] != width:
                raise ConfigError(f"{cfg.task}: its model has changed: {name} has {width} numbers, not as in the episodes")

    def show(self, number: int) -> dict[str, Any]:
        """Return the film of an episode for its page: `every` steps a picture, and `pictures` as JPEG in base64. Without a
        renderer, return the reason `why`, the `parents` of B bodies, and their `places` (T', B, 3) [m], world frame.
        """
        steps = int(self.episodes.lengths[number])
        every = max(1, round(1.0 / (FPS * self.episodes.dt)), -(-steps // MOST_PICTURES))
        shown = list(range(0, steps, every))
        try:
            return {"every": every, "width": WIDTH, "height": HEIGHT, "pictures": self._pictures(number, shown)}
        except RunError as error:
            return {"every": every, "why": str(error), **self._stick_figure(number, shown)}

    def _pictures(self, number: int, shown: list[int]) -> list[str]:
        one, task = self.episodes.of(number), self.task
        camera = camera_of(task, 1, WIDTH, HEIGHT)
        if isinstance(camera, RobotsCamera):
            camera.come_near(FILL, GLIDE)
            camera.arrows = True
        frames = []
        try:
            for step in shown:
                self._put(one, step)
                frames.append(Image.fromarray(camera.picture()))
        finally:
            camera.close()
        for quality in QUALITIES:
            found = [_jpeg(frame, quality) for frame in frames]
            if sum(map(len, found)) <= BUDGET_MB * 1e6:
                break
        return [base64.b64encode(picture).decode("ascii") for picture in found]

    def _put(self, one: dict[str, np.ndarray], step: int) -> None:
        """Put the robot into a recorded state, with its command."""
        task = self.task
        qpos, qvel = (torch.as_tensor(np.nan_to_num(one[name][step : step + 1])) for name in ("qpos", "qvel"))
        task.physics.write(torch.ones(1, dtype=torch.bool), qpos, qvel)
        task.physics.refresh()
        if isinstance(task, LeggedRobot):
            task.commands[:, :3].copy_(torch.as_tensor(one["command"][step]))

    def _stick_figure(self, number: int, shown: list[int]) -> dict[str, Any]:
        model = self.task.physics.model
        data, states, places = mujoco.MjData(model), self.episodes.of(number)["qpos"], []
        for step in shown:
            data.qpos[:] = np.nan_to_num(states[step])
            mujoco.mj_kinematics(model, data)
            places.append(data.xpos[1:].copy())
        moved = [i for i in range(1, model.nbody) if model.body_weldid[i] != 0]  # terrain is a part of the world
        rows = {body: row for row, body in enumerate(moved)}
        return {
            "parents": [rows.get(int(model.body_parentid[body]), -1) for body in moved],
            "places": np.round(np.array(places)[:, [body - 1 for body in moved]], 3).tolist(),
        }


def _jpeg(frame: Image.Image, quality: int) -> bytes:
    written = io.BytesIO()
    frame.save(written, "JPEG", quality=quality, optimize=True)
    return written.getvalue()
