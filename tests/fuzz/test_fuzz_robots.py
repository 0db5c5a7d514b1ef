"""Drawn robot folders: refused in a line, or a robot that can be simulated."""

import contextlib
import io
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from draws import HOW, NUMBERS, TEXTS, VALUES, changed_text, mutated, places
from helpers import TASK, call
from hypothesis import given
from hypothesis import strategies as st
from importing_fixtures import urdf
from outcomes import refused_in_a_line

from legged.cli.robot import add
from legged.process.paths import data_folder
from legged.registry import make_task, task_config

pytestmark = pytest.mark.slow

SOURCE = data_folder("resources") / "robots" / "anymal_c"
MODEL = (SOURCE / "anymal_c.xml").read_text()
URDF = urdf()
FILE = yaml.safe_load((SOURCE / "robot.yaml").read_text())
SMALL = [("env.num_envs", 2), ("sim.physics", "mujoco"), ("sim.threads", 1), ("train.algorithm.symmetry", False)]


def simulate(folder: Path) -> None:
    """Refused in one line, or stepped; what is NaN then is reset."""
    with refused_in_a_line():
        task = make_task(task_config(TASK, [("robot", str(folder)), *SMALL], on_cpu=True))
        for _ in range(3):
            observations, rewards, _, _ = task.step(torch.zeros(task.num_envs, task.num_actions))
        assert torch.isfinite(observations["actor"]).all()
        assert torch.isfinite(rewards).all()


@given(data=st.data(), how=HOW, value=VALUES)
def test_a_changed_robot_file(data, how, value, in_new_folder):
    path = data.draw(st.sampled_from(places(FILE)))
    with in_new_folder() as folder:
        shutil.copytree(SOURCE, folder / "mine")
        text = yaml.safe_dump(mutated(FILE, path, how, value), allow_unicode=True)
        (folder / "mine" / "robot.yaml").write_text(text, encoding="utf-8")
        simulate(folder / "mine")


@st.composite
def changed_model(draw: st.DrawFn, text: str = MODEL) -> str:
    """The MJCF, or another XML text, with some attributes changed, or some lines."""
    parts = text.split('"')  # every other one is an attribute's value
    for _ in range(draw(st.integers(1, 3))):
        i = 2 * draw(st.integers(0, (len(parts) - 2) // 2)) + 1
        numbers = parts[i].split()
        if draw(st.booleans()) and numbers:
            numbers[draw(st.integers(0, len(numbers) - 1))] = str(draw(NUMBERS))
            parts[i] = " ".join(numbers)
        else:
            parts[i] = draw(TEXTS).replace('"', "").replace("\0", "")[:100]
    return '"'.join(parts)


@given(text=st.one_of(changed_model(), changed_text(MODEL, TEXTS)))
def test_a_changed_model(text, in_new_folder):
    with in_new_folder() as folder:
        shutil.copytree(SOURCE, folder / "mine")
        (folder / "mine" / "anymal_c.xml").write_text(text, encoding="utf-8", errors="replace")
        simulate(folder / "mine")


@given(text=st.one_of(changed_model(URDF), changed_text(URDF, TEXTS)))
def test_a_changed_urdf(text, in_new_folder):
    """What is brought is refused in a line, or loads."""
    with in_new_folder() as folder:
        (folder / "toy.urdf").write_text(text, encoding="utf-8", errors="replace")
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as err:
            code = call(add.main, [str(folder / "toy.urdf"), "--name", "drawn_toy", "--out", str(folder)])
        assert code in (0, 2)
        assert err.getvalue().count("\n") == (1 if code else 0), err.getvalue()
