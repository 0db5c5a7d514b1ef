"""Many robots in one picture: where tiles and names are, how large a file may be, and that a robot fills its tile."""

from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from helpers import POLICY, TASK, call, small_config, small_task
from PIL import Image

from legged import registry
from legged.errors import RunError
from legged.play import contact_sheet as sheets
from legged.play.contact_sheet import film, sheet, walker, write_sheet
from legged.policies.restore import TrainedPolicy, policy_of
from legged.registry import task_config
from legged.rendering import RobotsCamera
from legged.tools import contact_sheet

pytestmark = pytest.mark.usefixtures("workplace")

RED, GREEN, BLUE = (200, 30, 30), (30, 200, 30), (30, 30, 200)


def plain(color, side=32, count=3):
    return [np.full((side, side, 3), color, dtype=np.uint8)] * count


def noise(side=64, count=4):
    return list(np.random.default_rng(0).integers(0, 255, (count, side, side, 3), dtype=np.uint8))


def test_tiles_are_side_by_side_with_their_names_below():
    pictures = sheet([plain(RED), plain(GREEN), plain(BLUE, count=2)], ["a1", "go1", "h1"], columns=2)
    assert len(pictures) == 2  # as long as the shortest
    assert pictures[0].shape == (2 * (32 + 14), 64, 3)
    for color, (row, column) in {RED: (0, 0), GREEN: (0, 1), BLUE: (1, 0)}.items():
        tile = pictures[1][46 * row : 46 * row + 32, 32 * column : 32 * column + 32]
        assert (tile == color).all()
        below = pictures[1][46 * row + 32 : 46 * row + 46, 32 * column : 32 * column + 32]
        assert below.max() == 255
        assert below.min() < 120  # ink
    assert (pictures[0][46:, 32:] == 255).all()


@pytest.mark.parametrize(("count", "shape"), [(1, (1, 1)), (2, (1, 2)), (3, (1, 3)), (8, (2, 4)), (10, (2, 5)), (20, (3, 7))])
def test_a_sheet_is_about_twice_as_wide_as_high(count, shape):
    (picture,) = sheet([plain(RED, count=1)] * count, ["x"] * count)
    assert picture.shape[:2] == (46 * shape[0], 32 * shape[1])


def test_a_png_is_the_picture_in_the_middle():
    pictures = noise(count=5)
    said = write_sheet(pictures, Path("new/sheet.png"))
    assert np.array_equal(np.asarray(Image.open("new/sheet.png")), pictures[2])
    assert said.startswith("written: new/sheet.png, 0.0")


def test_a_gif_shows_all_in_real_time_and_is_made_smaller_until_it_is_small_enough(monkeypatch):
    pictures = noise()
    write_sheet(pictures, Path("large.gif"))
    with Image.open("large.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (4, (64, 64), 80)
    monkeypatch.setattr(sheets, "MOST_BYTES", 4000)
    said = write_sheet(pictures, Path("small.gif"))
    assert Path("small.gif").stat().st_size <= 4000
    with Image.open("small.gif") as image:
        assert image.n_frames == 4
        assert image.size[0] < 64
        assert f"4 pictures of {image.size[0]} x {image.size[1]} pixels" in said
    monkeypatch.setattr(sheets, "MOST_BYTES", 100)
    with pytest.raises(RunError, match=r"none.gif: would be larger than 0.0001 MB"):
        write_sheet(pictures, Path("none.gif"))
    assert not Path("none.gif").exists()


def test_a_colour_that_is_rarely_there_keeps():
    grey = np.random.default_rng(0).integers(120, 240, (200, 200, 1), dtype=np.uint8).repeat(3, axis=2)
    grey[90:100, 90:100] = (240, 200, 10)  # a quarter of a percent
    write_sheet([grey], Path("a.gif"))
    with Image.open("a.gif") as image:
        shown = np.asarray(image.convert("RGB"))[95, 95].astype(int)
    assert abs(shown - (240, 200, 10)).max() < 12


@pytest.mark.parametrize(("width", "height"), [(120, 120), (200, 80), (60, 160)])
def test_a_robot_that_is_near_fills_its_picture(width, height):
    task = small_task(num_envs=1)
    task.reset()
    camera = RobotsCamera(task, 1, width, height)
    camera.come_near(0.8, 1.0)
    camera.picture()
    sides = np.array(camera.size.sides)
    base = np.array([*camera.data.qpos[:2], 0.5 * sides[2]])
    corners = base + 0.5 * sides * np.array(list(product((-1.0, 1.0), repeat=3)))
    reach = np.ptp(camera.pixels(corners), axis=0) / (width, height)
    camera.close()
    assert reach.max() == pytest.approx(0.8, abs=0.02)
    assert reach.min() < 0.8


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


def test_the_command_shows_tasks_and_run_folders(capsys):
    assert call(contact_sheet.main, [TASK, str(POLICY), "--out", "robots.gif", "--side", "32", "--columns", "1"]) == 0
    with Image.open("robots.gif") as image:
        assert image.size == (32, 2 * 46)
        assert image.n_frames == 50
    assert "written: robots.gif" in capsys.readouterr().out


def test_tiles_are_called_by_robot_task_or_run_whatever_tells_them_apart():
    configs = [small_config(), task_config("go2_flat"), task_config("go2")]
    policies = [TrainedPolicy(cfg, Path("logs", cfg.task, "10-30", "model_9.pt")) for cfg in configs]
    assert contact_sheet.names_of(policies) == ["anymal_c", "go2_flat", "go2"]
    policies.append(TrainedPolicy(configs[2], Path("logs", "go2", "11-15", "model_9.pt")))
    assert contact_sheet.names_of(policies) == ["anymal_c", "go2_flat", "go2 10-30", "go2 11-15"]


def test_a_robot_that_cannot_be_asked_to_walk_is_refused_before_others_are_filmed(capsys):
    assert call(contact_sheet.main, [TASK, "half_cheetah", "--out", "a.gif"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("error: TASK | RUN: 'half_cheetah' follows no commands")


def test_the_tasks_of_its_help_can_be_shown():
    first = contact_sheet.build_parser().examples[0].split()
    for task in first[first.index("legged.tools.contact_sheet") + 1 : first.index("--out")]:
        assert walker(policy_of(task)).task == task


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["anymal_flat", "--out", "a.gif"], "there is no task 'anymal_flat'"),
        (["untrained", "--out", "a.gif"], "'untrained': there is neither a run nor a shipped policy of this task"),
        (["half_cheetah", "--out", "a.gif"], "'half_cheetah' follows no commands"),
        ([TASK, "--out", "a.jpg"], "--out: must end in .gif or .png, got 'a.jpg'"),
        ([TASK, "--out", "a.gif", "--columns", "0"], "--columns: must be at least 1, got 0"),
        ([TASK, "--out", "a.gif", "--side", "5"], "--side: must be between 32 and 1000, got 5"),
    ],
)
def test_wrong_input_is_named(arguments, words, capsys, monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})
    registry.register("untrained", {"extends": TASK})
    assert call(contact_sheet.main, arguments) == 2
    assert words in capsys.readouterr().err
    assert not Path("a.gif").exists()
