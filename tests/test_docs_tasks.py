"""What docs/tasks.md, networks.md and randomisation.md show works: modules and YAML files, commands, excerpts, counts."""

import re
import shlex
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from helpers import call, forget_modules_of

from legged import registry, user_modules
from legged.cli.evaluate import episodes
from legged.cli.play import play
from legged.cli.train import train
from legged.physics import FIELDS
from legged.terrain import TERRAIN_TYPES
from legged.terrain.generators import Tile

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def fenced(page: str) -> list[tuple[str, str]]:
    """Return the blocks of a page, each with its language."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", page, flags=re.DOTALL | re.MULTILINE)


def named(page: str) -> list[tuple[str, str]]:
    """Return the file that a block says it is, in its first line, and the block without that line."""
    found = [re.fullmatch(r"# (\S+)\n(.*)", text, flags=re.DOTALL) for language, text in fenced(page) if language]
    return [(match[1], match[2]) for match in found if match]


RANDOMISATION = (ROOT / "docs" / "randomisation.md").read_text(encoding="utf-8")
TERRAIN = (ROOT / "docs" / "terrain.md").read_text(encoding="utf-8")
ACTUATORS = (ROOT / "docs" / "actuators.md").read_text(encoding="utf-8")
BLOCKS = [*named(PAGE), *named(RANDOMISATION)]
OTHERS = dict([*named(TERRAIN), *named(ACTUATORS)])
MODULES = {name: text for name, text in BLOCKS if "/" not in name}
EXCERPTS = [(name, text) for name, text in BLOCKS if "/" in name]
NETWORKS = (ROOT / "docs" / "networks.md").read_text(encoding="utf-8")
TEXTS = [*fenced(PAGE), *fenced(NETWORKS), *fenced(RANDOMISATION)]
COMMANDS = [line for language, text in TEXTS if not language for line in text.splitlines()]
TINY = [
    "--num-envs",
    "8",
    "--max-iterations",
    "1",
    "--run-name",
    "tiny",
    "train.runner.report=false",
    "train.runner.num_steps_per_env=4",
]
ENGINE = ["--sim-device", "cpu", "sim.physics=mujoco", "sim.threads=1"]
MAINS = {
    "legged train": (train.main, [*TINY, *ENGINE]),
    "legged play": (play.main, ["--num-envs", "1", *ENGINE]),
    "legged evaluate episodes": (episodes.main, ENGINE),
}


@pytest.fixture
def files(workplace, tmp_path, monkeypatch):
    """Write the page's files and the package's resources into the working directory; forget the tasks afterwards."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    monkeypatch.setattr(user_modules, "_IMPORTED", set())
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name, text in MODULES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "resources").symlink_to(ROOT / "resources")
    yield tmp_path
    forget_modules_of(tmp_path)


def run(command: str) -> int:
    """Return the exit code of a command of the page, with tiny settings."""
    program = next(name for name in MAINS if command.startswith(f"{name} "))
    main, small = MAINS[program]
    return call(main, [*shlex.split(command.removeprefix(program)), *small])


def lines(name: str) -> int:
    """Return how many lines of a file of the page or of the package are neither blank nor comments."""
    text = (MODULES | OTHERS).get(name) or (ROOT / name).read_text(encoding="utf-8")
    return sum(1 for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))


def task_of(command: str) -> str:
    """Return the name of the task that a command is about."""
    program = next(name for name in MAINS if command.startswith(f"{name} "))
    return Path(shlex.split(command.removeprefix(program))[0]).stem


SEVERAL = {task: [c for c in COMMANDS if task_of(c) == task] for task in dict.fromkeys(map(task_of, COMMANDS))}
"""Task -> the commands about it, in the order of the page: a policy is trained before it is played."""


@pytest.mark.slow
@pytest.mark.parametrize("task", SEVERAL)
def test_every_command_of_the_page_runs(files, task, capsys):
    for command in SEVERAL[task]:
        assert run(command) == 0, f"{command}: {capsys.readouterr().err}"
        trained = command.startswith("legged train ") and "--show" not in command
        assert not trained or list(files.glob(f"logs/{task}/*_tiny/model_0.pt"))


def test_every_file_of_the_page_is_used_by_a_command_of_it():
    used = " ".join(COMMANDS) + " ".join(MODULES.values())
    assert MODULES
    assert not [name for name in MODULES if name not in used]


@pytest.mark.slow
def test_the_ground_from_a_picture_is_trained_on(files, capsys):
    (module,) = named(TERRAIN)
    (files / module[0]).write_text(module[1], encoding="utf-8")
    grey = np.random.default_rng(0).integers(0, 256, (50, 60), dtype=np.uint8)
    iio.imwrite(files / "dunes.png", grey)
    (command,) = [line for _, text in fenced(TERRAIN) for line in text.splitlines() if "--import dunes.py" in line]
    try:
        assert run(command) == 0, capsys.readouterr().err
        tile = Tile(np.zeros((25, 30)), 0.1, np.random.default_rng(0))
        TERRAIN_TYPES["dunes"].generate(tile, 0.4)
        corners = 0.4 / 255.0 * grey[[0, 0, -1, -1], [0, -1, 0, -1]]
        np.testing.assert_allclose(tile.heights[[0, 0, -1, -1], [0, -1, 0, -1]], corners)
    finally:
        TERRAIN_TYPES.pop("dunes", None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "method"),
    [
        ("slip.py", "_reward_foot_slip"),
        ("feel.py", "_obs_foot_contact"),
        ("upright.py", "_terminate_leaning"),
        ("height.py", "_metric_base_height"),
        ("clearance.py", "_obs_clearance"),
        ("dance.py", "_reward_motion"),
    ],
)
def test_the_term_of_a_module_is_called(files, file, method, capsys):
    """A term that is there, but that no configuration names, would train as well."""
    (command,) = [command for command in COMMANDS if f"--import {file}" in command]
    source = (files / file).read_text(encoding="utf-8")
    raising = re.sub(rf"(def {method}\(self\):\n +\"\"\".*\"\"\"\n)", r"\1        raise ValueError('was called')\n", source)
    assert raising != source
    (files / file).write_text(raising, encoding="utf-8")
    assert run(command) != 0
    assert "was called" in capsys.readouterr().err


def test_the_counts_of_lines_are_those_of_the_files():
    table = re.findall(r"^\| [^|]+ \| (`[^|]+\.(?:py|yaml)`) \| ([\d +]+) \|$", PAGE, flags=re.MULTILINE)
    assert {name for names, _ in table for name in re.findall(r"`(\S+)`", names)} >= {*MODULES} - {
        "varied.yaml",
        "told.yaml",
        "busy.yaml",
    }
    for names, count in table:
        assert count == " + ".join(str(lines(name)) for name in re.findall(r"`(\S+)`", names)), names


@pytest.mark.parametrize(("file", "text"), EXCERPTS, ids=[f"{name}-{i}" for i, (name, _) in enumerate(EXCERPTS)])
def test_excerpts_are_what_the_files_say(file, text):
    assert text in (ROOT / file).read_text(encoding="utf-8")


def test_the_table_of_randomisation_names_every_field():
    part = RANDOMISATION.partition("## Distribution and time")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", part, flags=re.MULTILINE))
    units = {name: "" if field.unit == "1" else f" [{field.unit}]" for name, field in FIELDS.items()}
    assert rows == {name: f"{field.meaning}{units[name]}" for name, field in FIELDS.items()}


def test_the_reward_of_the_readme_is_that_of_the_page():
    assert dict(named(README)) == {"slip.py": MODULES["slip.py"]}
