"""Pages for users of legged_gym, Isaac Lab and mjlab: their module trains, and the names, terms and settings that they give
exist.
"""

import re
import sys
from pathlib import Path

import pytest
from helpers import ENGINE, call, small_task
from test_docs_tasks import fenced, named

from legged import math as legged_math
from legged import registry, user_modules
from legged.cli.migrate import _task_name
from legged.cli.train import train
from legged.config.loader import to_dict
from legged.config.schema import LeggedConfig
from legged.envs import LeggedRobot
from legged.envs.legged_gym_names import COMPUTED, CONSTANT, KEPT, PLAIN
from legged.terrain import TERRAIN_TYPES

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "migrating.md").read_text(encoding="utf-8")
FILES = dict(named(PAGE))
OTHERS = [
    (DOCS / f"from_{name}.md").read_text(encoding="utf-8").partition("\n## Names\n")[2] for name in ("isaac_lab", "mjlab")
]
"""What Isaac Lab and mjlab call things, beside our names."""


def column(text: str, index: int) -> set[str]:
    """Return what the rows of a text's tables have in backquotes in a column."""
    rows = [row.split("|") for row in text.splitlines() if row.startswith("| ")]
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


def test_rewards_are_the_same_lines_before_and_after():
    before, after, _ = [text for language, text in fenced(PAGE) if language == "python"]

    def rewards(text: str) -> list[str]:
        return re.findall(r"    def _reward_\w+\(self\):\n(?:        .*\n)+", text)

    assert len(rewards(before)) == 3
    assert rewards(before) == rewards(after)


def test_names_of_legged_gym_are_all_of_them():
    text = PAGE[PAGE.index("### Code that needs no change") : PAGE.index("### Code to change")]
    assert column(text, 1) == {*PLAIN, *COMPUTED, *CONSTANT, *KEPT}


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
    settings |= {"robot", "link_mass", "terminate_after_contacts_on", "dof_names", "_init_buffers", "std", *TERRAIN_TYPES}
    named_here = {part for name in column(table, 2) for part in re.findall(r"\w+", name)} - {"self"}
    assert named_here
    assert named_here <= terms | settings


@pytest.mark.parametrize("table", OTHERS, ids=["Isaac Lab", "mjlab"])
def test_what_has_to_be_written_is_not_there(table):
    (row,) = [line for line in table.splitlines() if "| none; write your own" in line]
    names = column(row, 1)
    assert names
    assert not names & LeggedRobot.terms("_reward_")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["last_air_time", "first_contact", "in_contact"])
def test_contacts_have_what_the_page_says(name):
    assert f"`.{name}`" in PAGE
    assert hasattr(small_task(num_envs=1).contacts, name)
