"""Pages for users of legged_gym, Isaac Lab and mjlab: their module trains, and the names, terms and settings that they give
exist.
"""

import re
import sys
from pathlib import Path

import pytest
import torch
from helpers import ENGINE, call
from test_docs_tasks import fenced, named

from legged import math as legged_math
from legged import registry, user_modules
from legged.cli.migrate import _task_name
from legged.cli.train import train
from legged.config.legged import LeggedConfig
from legged.config.loader import to_dict
from legged.envs import LeggedRobot
from legged.envs.legged_gym_names import COMPUTED, CONSTANT, KEPT, PLAIN, SUBSTEPS
from legged.math import quat_rotate, yaw_of
from legged.registry import make_task, task_config
from legged.terrain import TERRAIN_TYPES

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "migrating.md").read_text(encoding="utf-8")
FILES = dict(named(PAGE))
OTHERS = [
    (DOCS / f"from_{name}.md").read_text(encoding="utf-8").partition(f"\n## {first}\n")[2]
    for name, first in (("isaac_lab", "Rewards"), ("mjlab", "Names"))
]
"""What Isaac Lab and mjlab call things, beside our names."""


def column(text: str, index: int) -> set[str]:
    """Return what the rows of a text's tables have in backquotes in a column."""
    rows = [row.split("|") for row in text.splitlines() if row.startswith("|")]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row[index])}


def test_the_first_commands_name_the_file_that_is_written():
    """This package has a task go2, so that the new task is my_go2."""
    assert f"--task go2 --robot robots/go2 --out tasks --run\nlegged train tasks/{_task_name('go2')}.yaml --show\n" in PAGE


@pytest.fixture
def files(workplace, tmp_path, monkeypatch):
    """Write the page's files into the working directory; forget the tasks afterwards."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    monkeypatch.setattr(user_modules, "_IMPORTED", set())
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_the_class_that_was_ported_trains():
    (command,) = [text.strip() for language, text in fenced(PAGE) if not language and "trot" in text]
    arguments = command.removeprefix("python train.py ").split()
    settings = [f"{key}={value}" for key, value in ENGINE]
    tiny = ["--num-envs", "8", "--max-iterations", "1", "--sim-device", "cpu", "train.runner.num_steps_per_env=4"]
    tiny.append("train.runner.report=false")
    assert call(train.main, [*arguments, *tiny, *settings]) == 0


def test_rewards_that_the_page_shows_once_are_in_the_ported_class():
    before, after, _ = [text for language, text in fenced(PAGE) if language == "python"]
    (line,) = [line for line in before.splitlines() if line.endswith(" as below")]
    names = re.findall(r"_reward_\w+", line)
    assert len(names) == 3
    assert names == re.findall(r"def (_reward_\w+)\(self\)", after)


def test_names_of_legged_gym_are_all_of_them():
    text = PAGE[PAGE.index("### Code that needs no change") : PAGE.index("### Code to change")]
    assert column(text, 1) == {*PLAIN, *COMPUTED, *CONSTANT, *KEPT, *SUBSTEPS}


def test_functions_of_mathematics_are_there():
    (line,) = re.findall(r"`from legged\.math import ([^`]+)`", PAGE)
    assert all(callable(getattr(legged_math, name)) for name in line.split(", "))


@pytest.mark.parametrize("table", OTHERS, ids=["Isaac Lab", "mjlab"])
def test_terms_and_settings_beside_those_of_others_are_there(table):
    terms = {name for prefix in ("_reward_", "_obs_", "_terminate_") for name in LeggedRobot.terms(prefix)}
    settings = set()

    def collect(data: dict) -> None:
        for key, value in data.items():
            settings.add(key)
            collect(value) if isinstance(value, dict) else None

    collect(to_dict(LeggedConfig()))
    settings |= {"robot", "link_mass", "terminate_after_contacts_on", "std", *TERRAIN_TYPES}  # keys of other files too
    code = {"_init_buffers", "advance", "apply_control", "contact_forces", "contacts", "in_contact", "cinert", "cvel"}
    paths = [name for name in column(table, 2) if re.fullmatch(r"[\w.]+", name)]
    named_here = {part for name in paths for part in name.split(".")} - {"", "self", "_metric_x", "legged", "math"}
    assert len(named_here) > 15
    assert named_here <= terms | settings | code


@pytest.mark.parametrize("table", OTHERS, ids=["Isaac Lab", "mjlab"])
def test_expressions_beside_terms_of_others_give_a_number_for_each_robot(table):
    """Some are factors of a reward, with a column for each joint or axis."""
    settings = [("env.num_envs", 3), *ENGINE]
    task = make_task(task_config("go2_flat", settings, on_cpu=True))
    numbers = {"std": 0.5, "target": 0.1, "threshold": 0.4, "low": 0.1, "high": 0.5, "c": task.contacts}
    known = {"self": task, "torch": torch, "quat_rotate": quat_rotate, "yaw_of": yaw_of, **numbers}
    codes = [code.removeprefix("return ").replace("hip_yaw", "hip") for code in column(table, 2)]
    values = [eval(code, known) for code in codes if re.search(r"\bself\.|^torch\.", code) and "c =" not in code]
    assert len(values) > 5
    assert all(len(value) == 3 for value in values if isinstance(value, torch.Tensor))
