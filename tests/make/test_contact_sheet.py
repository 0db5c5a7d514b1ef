"""docs/make/contact_sheet.py: tiles and names, and wrong input."""

from pathlib import Path

import contact_sheet
import numpy as np
import pytest
from contact_sheet import sheet
from helpers import POLICY, TASK, call, small_config
from PIL import Image

from legged import registry
from legged.play.films import walker
from legged.policies.restore import TrainedPolicy, policy_of
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")

RED, GREEN, BLUE = (200, 30, 30), (30, 200, 30), (30, 30, 200)


def plain(color, side=32, count=3):
    return [np.full((side, side, 3), color, dtype=np.uint8)] * count


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


@pytest.mark.slow
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
    for task in first[first.index("docs/make/contact_sheet.py") + 1 : first.index("--out")]:
        assert walker(policy_of(task)).task == task


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["anymal_flat", "--out", "a.gif"], "no run 'anymal_flat'; did you mean 'anymal_d_flat'"),
        (["untrained", "--out", "a.gif"], "'untrained' has neither a run in logs/untrained nor a shipped policy"),
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
