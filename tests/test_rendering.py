"""Pictures: the robots are in them, move in them, and carry their arrows and captions."""

import mujoco
import numpy as np
import pytest
import torch

from legged.registry import make_task, task_config
from legged.rendering import Camera

WIDTH, HEIGHT = 320, 180


@pytest.fixture(scope="module")
def task():
    changes = {"env.num_envs": 3, "sim.physics": "mujoco", "env.seed": 5}
    return make_task(task_config("anymal_c_flat", changes.items(), on_cpu=True))


@pytest.fixture
def camera(task):
    """Two of the three robots, standing where their episode began, without commands."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")
    task.reset()
    task.commands.zero_()
    task.base_lin_vel.zero_()
    camera = Camera(task, count=2, width=WIDTH, height=HEIGHT)
    yield camera
    camera.close()


def red(picture: np.ndarray) -> np.ndarray:
    """(h, w) pixels of the robots' shells; floor, sky and arrows are grey, blue and green."""
    r, g, b = (picture[:, :, i].astype(int) for i in range(3))
    return (r > 60) & (r > 2 * g) & (r > 2 * b)


def differ(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(h, w) pixels that differ by more than the renderer's rounding."""
    return (np.abs(one.astype(int) - other) > 4).any(axis=2)


def test_picture_shows_the_robots(camera):
    picture = camera.picture()
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    assert 0.005 < red(picture).mean() < 0.3
    columns = np.flatnonzero(red(picture).any(axis=0))
    assert columns.max() - columns.min() > WIDTH / 4  # side by side


def test_each_robot_is_drawn(task, camera):
    """One robot from the same distance shows half of the red, and for one the camera comes nearer."""
    both = red(camera.picture()).sum()
    single = Camera(task, count=1, width=WIDTH, height=HEIGHT)
    assert single.view.distance < camera.view.distance
    single.view.distance = camera.view.distance
    one = red(single.picture()).sum()
    single.close()
    assert 0.3 * both < one < 0.7 * both


def test_picture_is_the_same_until_the_robots_move(task, camera):
    first = camera.picture()
    assert not differ(camera.picture(), first).any()
    for _ in range(10):
        task.step(torch.full((3, 12), 2.0))
    task.commands.zero_()
    task.base_lin_vel.zero_()
    assert differ(camera.picture(), first).mean() > 0.01


def test_commanded_velocity_is_a_green_arrow(task, camera):
    def green(picture: np.ndarray) -> int:
        r, g, b = (picture[:, :, i].astype(int) for i in range(3))
        return int(((g > 1.5 * r) & (g > 1.5 * b) & (g > 60)).sum())

    assert green(camera.picture()) == 0
    task.commands[0, 0] = 1.0
    one = green(camera.picture())
    assert one > 20
    task.commands[1, 0] = 1.0
    assert green(camera.picture()) > 1.5 * one
    task.commands[2, 0] = 1.0  # is not in the picture


def test_caption_is_drawn_in_the_upper_left_corner_only(camera):
    plain = camera.picture()
    captioned = camera.picture(["commanded 1.0 m/s", "actual 0.9 m/s"])
    assert captioned.shape == plain.shape
    assert captioned.dtype == np.uint8
    changed = differ(captioned, plain)
    rows, columns = np.nonzero(changed)
    assert changed.sum() > 500
    assert rows.max() < HEIGHT / 4
    assert columns.max() < WIDTH / 2
    text = captioned[: HEIGHT // 4, : WIDTH // 2].astype(int)
    assert (text.max(axis=2) - text.min(axis=2) > 60).any()  # letters in the colours of the arrows
    assert not differ(camera.picture(), plain).any()  # nothing stays
