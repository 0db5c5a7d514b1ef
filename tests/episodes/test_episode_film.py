"""A recorded episode is shown as it was: on its ground, in its states; its pictures fit into a page."""

import base64
import io

import numpy as np
import pytest
import torch
from helpers import ENGINE, POLICY, small_task
from PIL import Image

from legged.episodes import page
from legged.episodes.page import Projector
from legged.episodes.recorder import Wish, roll_out
from legged.errors import RunError
from legged.policies.restore import policy_of
from legged.registry import task_config
from legged.rendering.scene import display_model
from legged.terrain import TERRAIN_TYPES, Terrain

SHORT = (("env.episode_length_s", 0.4), ("sim.threads", 1))
STAIRS = {**dict.fromkeys(TERRAIN_TYPES, 0.0), "stairs_up": 1.0}
FEW_TILES = (
    ("terrain.num_rows", 3),
    ("terrain.max_init_terrain_level", 2),
    ("terrain.num_cols", 2),
    ("terrain.border_size", 2.0),
    ("terrain.proportions", STAIRS),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wish",
    [
        Wish(3, 3, changes=(*SHORT, *FEW_TILES)),
        Wish(3, 3, terrain="rough_slope_up", difficulty=0.7, changes=SHORT),
        Wish(3, 3, difficulty=0.4, changes=SHORT),
        Wish(3, 3, as_trained=True, changes=(*SHORT, *FEW_TILES)),
    ],
    ids=["training's ground", "tiles of a type", "tiles of the task", "as trained"],
)
def test_the_ground_below_a_robot_is_that_of_the_recording(wish):
    torch.set_num_threads(1)
    episodes, cfg = roll_out(policy_of(str(POLICY.parent / "anymal_c")), wish, torch.device("cpu"))
    projector = Projector(episodes, cfg)
    grounds = []
    for number in range(3):
        one = episodes.of(number)
        for step in (0, 19):
            projector._put(one, step)
            projector.task.sense()
            np.testing.assert_allclose(projector.task.base_pos[0], one["qpos"][step, :3], atol=1e-6)
            np.testing.assert_allclose(projector.task.feet_pos[0], one["feet_pos"][step], atol=1e-4)
            np.testing.assert_allclose(float(projector.task.height_scan.ground[0]), one["ground"][step], atol=1e-6)
            np.testing.assert_allclose(projector.task.commands[0, :3], one["command"][step], atol=1e-6)
            grounds.append(one["ground"][step])
    assert np.abs(grounds).max() > 0.05  # it is not the level around the tiles


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.7, 0.35])  # of what they take when they are fine; stairs in full view need the second
def test_pictures_are_so_coarse_that_they_fit(share, monkeypatch):
    """Noise does not compress: it gets the lowest quality but one that is small enough."""
    task = small_task(("env.episode_length_s", 0.4), num_envs=1)

    class Noise:
        def __init__(self, *_):
            self.random = np.random.default_rng(0)

        def picture(self):
            return self.random.integers(0, 255, (36, 64, 3), dtype=np.uint8)

        def close(self): ...

    monkeypatch.setattr(page, "camera_of", Noise)
    episodes, cfg = roll_out(policy_of(str(POLICY)), Wish(1, 1, changes=SHORT), torch.device("cpu"))
    projector = Projector(episodes, cfg)
    assert task.dt == pytest.approx(0.02)
    fine = projector.show(0)
    assert (fine["every"], len(fine["pictures"])) == (2, 10)  # 25 a second
    size = len(base64.b64decode("".join(fine["pictures"][:1]))) * 10
    monkeypatch.setattr(page, "BUDGET_MB", share * size / 1e6)
    coarse = projector.show(0)["pictures"]
    assert sum(len(base64.b64decode(picture)) for picture in coarse) <= share * size
    assert Image.open(io.BytesIO(base64.b64decode(coarse[0]))).size == (64, 36)
    monkeypatch.setattr(page, "MOST_PICTURES", 3)
    assert len(projector.show(0)["pictures"]) == 3


@pytest.mark.slow
def test_ground_that_is_larger_than_the_horizon_is_drawn():
    changes = [*ENGINE, *FEW_TILES, ("terrain.border_size", 110.0), ("terrain.horizontal_scale", 0.2)]
    cfg = task_config("anymal_c_blind", changes, on_cpu=True)
    terrain = Terrain.build(cfg.terrain, 1)
    assert max(terrain.height_map.size) > 200.0
    task = small_task(num_envs=1)
    model = display_model(task.robot, 1, 64, 36, terrain)
    assert (model.geom_size[:, :2].max(axis=1) > 0.0).all()


@pytest.mark.slow
def test_an_episode_is_drawn_where_pictures_can_be_made(monkeypatch):
    monkeypatch.setattr(page, "MOST_PICTURES", 2)
    episodes, cfg = roll_out(policy_of(str(POLICY)), Wish(1, 1, changes=SHORT), torch.device("cpu"))
    projector = Projector(episodes, cfg)
    try:
        found = projector._pictures(0, [0, 19])
    except RunError as error:
        pytest.skip(str(error))
    first, last = (np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))), dtype=int) for picture in found)
    assert first.shape == (page.HEIGHT, page.WIDTH, 3)
    assert np.abs(first - last).max() > 50  # the robot has moved
    red = (first[:, :, 0] > 140) & (first[:, :, 1] < 60)
    assert red.sum() > 1000  # ANYmal C is red, and near
