"""Films of walking robots: file sizes, colours, and a robot that fills its picture."""

from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from helpers import TASK, small_task
from PIL import Image

from legged.errors import RunError
from legged.play import films
from legged.play.films import film, write_film
from legged.policies.restore import policy_of
from legged.rendering.camera import RobotsCamera

pytestmark = pytest.mark.usefixtures("workplace")


def noise(side=64, count=4):
    return list(np.random.default_rng(0).integers(0, 255, (count, side, side, 3), dtype=np.uint8))


def test_a_png_is_the_picture_in_the_middle():
    pictures = noise(count=5)
    said = write_film(pictures, Path("new/film.png"))
    assert np.array_equal(np.asarray(Image.open("new/film.png")), pictures[2])
    assert said.startswith("written: new/film.png, 0.0")


@pytest.mark.slow
def test_a_gif_shows_all_in_real_time_and_is_made_smaller_until_it_is_small_enough(monkeypatch):
    pictures = noise()
    write_film(pictures, Path("large.gif"))
    with Image.open("large.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (4, (64, 64), 80)
    monkeypatch.setattr(films, "MOST_BYTES", 4000)
    said = write_film(pictures, Path("small.gif"))
    assert Path("small.gif").stat().st_size <= 4000
    with Image.open("small.gif") as image:
        assert image.n_frames == 4
        assert image.size[0] < 64
        assert f"4 pictures of {image.size[0]} x {image.size[1]} pixels" in said
    monkeypatch.setattr(films, "MOST_BYTES", 100)
    with pytest.raises(RunError, match=r"none.gif: the GIF would be larger than 0.0001 MB"):
        write_film(pictures, Path("none.gif"))
    assert not Path("none.gif").exists()


def test_a_colour_that_is_rarely_there_keeps():
    grey = np.random.default_rng(0).integers(120, 240, (200, 200, 1), dtype=np.uint8).repeat(3, axis=2)
    grey[90:100, 90:100] = (240, 200, 10)  # a quarter of a percent
    write_film([grey], Path("a.gif"))
    with Image.open("a.gif") as image:
        shown = np.asarray(image.convert("RGB"))[95, 95].astype(int)
    assert abs(shown - (240, 200, 10)).max() < 12


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(120, 120), (200, 80), (60, 160)])
def test_a_robot_that_is_near_fills_its_picture(width, height):
    task = small_task(num_envs=1)
    task.reset()
    camera = RobotsCamera(task, 1, width, height)
    camera.come_near(0.8, 1.0)
    camera.picture()
    sides = camera.sides
    base = np.array([*camera.data.qpos[:2], 0.5 * sides[2]])
    corners = base + 0.5 * sides * np.array(list(product((-1.0, 1.0), repeat=3)))
    reach = np.ptp(camera.pixels(corners), axis=0) / (width, height)
    camera.close()
    assert reach.max() == pytest.approx(0.8, abs=0.02)
    assert reach.min() < 0.8


@pytest.mark.slow
def test_the_shipped_robot_walks_through_its_tile(capsys):
    """On stairs as well: its picture changes all the time, and its colour stays in the middle."""
    for task in (TASK, "anymal_c"):
        pictures = film(policy_of(task), 48)
        assert len(pictures) == 50
        assert {picture.shape for picture in pictures} == {(48, 48, 3)}
        for before, after in pairwise(pictures):
            assert (before != after).mean() > 0.05
        for picture in pictures:
            middle = picture[10:38, 10:38].astype(int)
            red = (middle[..., 0] > 100) & (middle[..., 1] < 60) & (middle[..., 2] < 60)
            assert red.mean() > 0.03
