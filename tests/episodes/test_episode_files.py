"""Stored episodes come back as they were; damaged ones are refused in one line."""

import errno
import json
import re
from pathlib import Path

import numpy as np
import pytest
from handmade import made_by_hand
from helpers import small_config

from legged.cli.episodes import LIST
from legged.episodes.joint_statistics import NAME
from legged.episodes.stored import ABOUT, ARRAYS, CONFIG, TABLE, load_config, load_episodes, save_episodes
from legged.errors import ConfigError, RunError

pytestmark = pytest.mark.usefixtures("workplace")


def saved() -> Path:
    episodes = made_by_hand(3, 5)
    episodes["joint_pos"][:] = np.random.default_rng(0).normal(size=episodes["joint_pos"].shape)
    save_episodes(episodes, small_config(), Path("kept"))
    return Path("kept")


def test_episodes_come_back_as_they_were():
    folder = saved()
    found, want = load_episodes(folder, "FOLDER"), made_by_hand(3, 5)
    assert found.about == want.about
    assert found.arrays.keys() == want.arrays.keys()
    np.testing.assert_array_equal(found["joint_pos"], np.random.default_rng(0).normal(size=(8, 4)).astype(np.float32))
    assert load_config(folder, "FOLDER").task == "anymal_c_flat"
    with np.load(folder / ARRAYS) as plain:  # as somebody reads it who knows nothing of this package
        np.testing.assert_allclose(plain["time"], 0.02 * np.array([1, 2, 3, 1, 2, 3, 4, 5]), rtol=1e-6)
        assert plain["episode"].tolist() == [0] * 3 + [1] * 5


@pytest.mark.parametrize("full", [ARRAYS, CONFIG, ABOUT])
def test_numbers_are_never_described_by_an_earlier_recording(full, monkeypatch):
    """The disk is full at one of the files: the earlier recording stays as it was, or there is none."""
    folder, replace = saved(), Path.replace
    before = {path: path.read_bytes() for path in folder.iterdir()}

    def fail(self, target):
        if target.name == full:
            raise OSError(errno.ENOSPC, "no space")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(RunError, match=f"kept/{full}: no space left on the disk"):
        save_episodes(made_by_hand(4, 4), small_config(), folder)
    if {path: path.read_bytes() for path in folder.iterdir()} != before:
        with pytest.raises(ConfigError, match=f"kept holds no {ABOUT}"):
            load_episodes(folder, "FOLDER")


def test_a_recording_takes_away_what_was_made_of_the_one_before_it():
    folder = saved()
    made = ["episode_003.html", "episode_1000.html", f"{NAME}.md", f"{NAME}.html", f"{NAME}.png", LIST, TABLE]
    own = ["notes.md", "episode_best.html"]
    for name in made + own:
        (folder / name).write_text(name)
    save_episodes(made_by_hand(4, 4), small_config(), folder)
    assert {path.name for path in folder.iterdir()} == {ARRAYS, ABOUT, CONFIG, *own}
    assert load_episodes(folder, "FOLDER").lengths.tolist() == [4, 4]


def cut(path: Path):
    path.write_bytes(path.read_bytes()[:200])


def change(**entries):
    def apply(folder: Path):
        about = json.loads((folder / ABOUT).read_text())
        (folder / ABOUT).write_text(json.dumps({**about, **entries}))

    return apply


def replace_array(name: str, array: np.ndarray):
    def apply(folder: Path):
        with np.load(folder / ARRAYS) as file:
            arrays = {**file}
        np.savez(folder / ARRAYS, **{**arrays, name: array})

    return apply


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / ARRAYS).unlink(), f"kept holds no {ARRAYS}"),
        (lambda folder: cut(folder / ARRAYS), "the episodes there are damaged"),
        (lambda folder: (folder / ABOUT).write_text("{"), "the episodes there are damaged"),
        (lambda folder: (folder / ABOUT).write_text("[]"), "the whole file: expected a mapping, got list"),
        (change(format=99), "format: expected 1, got int '99'"),
        (change(arrays={}), r"arrays\.\w+: expected a mapping, got nothing"),
        (change(dt=0.0), "dt: expected a number above 0"),
        (change(joints=[]), r"joint_pos: expected rows of shape \(0,\), got \(4,\)"),
        (change(feet=["one"]), r"feet_pos: expected rows of shape \(1, 3\), got \(2, 3\)"),
        (change(terminations=["one"]), r"ended_by: expected rows of shape \(1,\), got \(2,\)"),
        (replace_array("torque", np.zeros((7, 4))), "torque: expected 8 rows of numbers, got shape"),
        (replace_array("torque", np.full((8, 4), "x")), "torque: expected 8 rows of numbers"),
        (replace_array("qvel", np.zeros((8, 3))), r"arrays\.qvel\.columns: expected names"),
        (replace_array("episode_start", np.array([0, 9, 8])), "episode_start does not hold"),
    ],
)
def test_damaged_episodes_are_refused(damage, words):
    folder = saved()
    damage(folder)
    with pytest.raises(ConfigError, match=words) as caught:
        load_episodes(folder, "FOLDER")
    assert re.match("FOLDER: kept", str(caught.value))


def test_a_folder_without_configuration_is_told():
    (saved() / CONFIG).unlink()
    with pytest.raises(ConfigError, match=f"--page: kept holds no {CONFIG}"):
        load_config(Path("kept"), "--page")
