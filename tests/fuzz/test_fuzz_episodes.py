"""Damaged episodes, and command lines about them: success, or one line."""

import contextlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from draws import HOW, TEXTS, VALUES, mutated, places
from helpers import POLICY, kept_global_state
from hypothesis import given
from hypothesis import strategies as st

from legged.cli.episodes import list_, record
from legged.episodes.joint_statistics import joint_statistics, tables_of
from legged.episodes.page import Panels
from legged.episodes.ranking import figures_of
from legged.episodes.stored import ABOUT, ARRAYS, load_episodes
from legged.errors import ConfigError

pytestmark = pytest.mark.slow

FEW = ["--physics=mujoco", "--episodes=2", "sim.threads=1", "env.episode_length_s=1.2"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    with kept_global_state():
        assert record.main([str(POLICY), *FEW, "--out", str(folder)]) == 0
    return folder


def looked_at(folder: Path) -> None:
    """Everything that is made of stored episodes but pictures."""
    found = load_episodes(folder, "FOLDER")
    figures_of(found)
    for number in range(len(found)):
        json.dumps(Panels(found, number).sections(), allow_nan=False)
    tables_of({"one": joint_statistics(found)})


@given(data=st.data(), how=HOW, value=VALUES)
def test_damaged_words(data, how, value, recorded, run, in_new_folder):
    about = json.loads((recorded / ABOUT).read_text())
    path = data.draw(st.sampled_from(places(about)))
    with in_new_folder() as folder:
        shutil.copytree(recorded, folder / "kept")
        text = json.dumps(mutated(about, path, how, value))
        Path("kept", ABOUT).write_text(text, encoding="utf-8", errors="replace")
        with contextlib.suppress(ConfigError):
            looked_at(folder / "kept")
        assert run(list_.main, ["kept"]).code in (0, 2)


@given(data=st.data())
def test_damaged_numbers(data, recorded, in_new_folder):
    content = bytearray((recorded / ARRAYS).read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    with in_new_folder() as folder:
        shutil.copytree(recorded, folder / "kept")
        end = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
        Path("kept", ARRAYS).write_bytes(bytes(content[:end]))
        with contextlib.suppress(ConfigError):
            looked_at(folder / "kept")


@given(
    data=st.data(), name=st.sampled_from(["qpos", "torque", "feet_contact", "ended_by", "reward", "failed", "episode_start"])
)
def test_arrays_of_another_kind(data, name, recorded, in_new_folder):
    shape = data.draw(st.lists(st.integers(0, 5), max_size=3))
    kind = data.draw(st.sampled_from(["float32", "int64", "bool", "U3", "complex64"]))
    with in_new_folder() as folder:
        shutil.copytree(recorded, folder / "kept")
        with np.load(recorded / ARRAYS) as file:
            np.savez(folder / "kept" / ARRAYS, **{**file, name: np.zeros(shape, dtype=kind)})
        with contextlib.suppress(ConfigError):  # sometimes it is of the right kind
            looked_at(folder / "kept")


NUMBERS = st.sampled_from(["-1", "0", "1", "2", "0.5", "1e9", "nan", "inf", "x", ""])
FLAGS = {
    "--episodes": NUMBERS,
    "--num-envs": NUMBERS,
    "--top": NUMBERS,
    "--sort": st.one_of(st.sampled_from(["fell", "torque", "tracking"]), TEXTS),
    "--ended": st.one_of(st.just("time"), TEXTS),
    "--page": st.one_of(st.sampled_from(["9", "0,x", ",", "1e3"]), TEXTS),
    "--difficulty": NUMBERS,
    "--out": TEXTS,
    "--command": st.one_of(st.sampled_from(["0.5,0,0.2", "nan,0,0", "1,2", ",,"]), TEXTS),
}


@given(flags=st.lists(st.sampled_from(sorted(FLAGS)).flatmap(lambda f: FLAGS[f].map(lambda v: f"{f}={v}")), max_size=3))
def test_any_command_line(flags, run, in_new_folder):
    with in_new_folder():
        if any(flag.startswith("--page=") and flag[7:].strip(", ").isdecimal() for flag in flags):
            flags = [flag for flag in flags if not flag.startswith("--page=")]  # no pictures here
        arguments = [str(POLICY), "--sim-device", "cpu", *FEW, "env.episode_length_s=0.1"]
        assert run(record.main, [*arguments, *flags]).code in (0, 1, 2)
