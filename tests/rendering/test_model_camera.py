"""Pictures of tasks that bring their own model: the camera goes with it."""

import mujoco
import numpy as np
import pytest
import torch

from legged.registry import make_task, task_config
from legged.rendering.camera import ModelCamera

WIDTH, HEIGHT = 320, 180


@pytest.fixture
def task():
    changes = [("env.num_envs", 2), ("sim.physics", "mujoco"), ("sim.threads", 1)]
    return make_task(task_config("half_cheetah", changes, on_cpu=True))


@pytest.fixture
def camera(task):
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")
    found = ModelCamera(task, WIDTH, HEIGHT)
    yield found
    found.close()


def put(task, env: int, x: float) -> None:
    """Put one cheetah somewhere, in the model's own pose."""
    qpos = task.qpos0.repeat(2, 1)
    qpos[:, 0] = x
    task.physics.write(torch.arange(2) == env, qpos, torch.zeros(2, task.physics.qvel.shape[1]))
    task.physics.refresh()


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.0, 37.3])
def test_the_followed_cheetah_is_in_the_middle(task, camera, x):
    put(task, 1, x)
    camera.followed = 1
    picture = camera.picture(["1.0 s"])
    assert picture.shape == (HEIGHT, WIDTH, 3)
    com = camera.data.subtree_com[1]
    assert com[0] == pytest.approx(x, abs=0.2)
    np.testing.assert_allclose(camera.pixels(com[None])[0], [WIDTH / 2, HEIGHT / 2], atol=1.0)
    ends = camera.pixels(com + np.array([[-0.6, 0, 0], [0.6, 0, 0]]))
    assert 0.2 * WIDTH < ends[1, 0] - ends[0, 0] < 0.8 * WIDTH  # x goes to the right


@pytest.mark.slow
def test_pictures_leave_the_simulated_model_alone(task, camera):
    assert task.physics.model.vis.quality.shadowsize > 0
    assert camera.model.vis.quality.shadowsize == 0


@pytest.mark.slow
def test_a_moving_cheetah_changes_the_picture(task, camera):
    put(task, 0, 0.0)
    first = camera.picture().astype(int)
    assert (np.abs(camera.picture() - first) > 4).mean() == 0.0
    for _ in range(4):
        task.step(torch.ones(2, 6))
    assert (np.abs(camera.picture() - first) > 4).mean() > 0.005


def test_the_floor_is_drawn_wherever_a_cheetah_runs(task, camera):
    """Its plane is drawn up to 40 m. At 500 m there are squares still, not one colour."""
    for x in (0.0, 500.0):
        put(task, 0, x)
        ground = camera.picture().astype(int)[HEIGHT // 2 :]
        assert len({int(value) // 30 for value in ground[:, :, 0].flatten()}) > 2, x
