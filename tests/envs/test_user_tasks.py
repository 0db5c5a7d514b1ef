"""Tasks of users: YAML files, modules and registered mappings, the robots they name; and their mistakes, in one line each."""

import random
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import ENGINE, TASK, call, forget_modules_of, small_task, tiny_run

from legged import LeggedRobot, registry, user_modules
from legged.cli.episodes import compare
from legged.cli.evaluate import grid as evaluate_grid
from legged.cli.train import train
from legged.config import from_dict
from legged.config.loader import read_yaml
from legged.errors import ConfigError, TermError
from legged.gymnasium_envs import TaskVectorEnv
from legged.learning.run_state import kept_generators
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace", "own_registry")


@pytest.fixture
def own_registry(monkeypatch, tmp_path):
    """The registry, path and modules, without what a test adds to them."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    monkeypatch.setattr(user_modules, "_IMPORTED", set())
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    forget_modules_of(tmp_path)


@pytest.fixture
def show(capsys):
    """show(arguments...): what `train.py --show` prints; its exit code is 0."""

    def show(*arguments):
        code = call(train.main, [*arguments, "--sim_device", "cpu", "--show"])
        out, err = capsys.readouterr()
        assert code == 0, err
        return from_dict(read_yaml(written("shown.yaml", out)))

    return show


@pytest.fixture
def error(capsys):
    """error(arguments...): the one line on stderr; the exit code is 2 and nothing is left behind."""

    def error(*arguments):
        code = call(train.main, [*arguments, "--sim_device", "cpu", "--show"])
        out, err = capsys.readouterr()
        assert (code, out) == (2, ""), err
        assert err.startswith("error: ")
        assert err.endswith("\n")
        assert err.count("\n") == 1
        assert not Path("logs").exists()
        return err

    return error


def written(path: str, text: str) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def robot_at(folder: str) -> Path:
    """A copy of ANYmal C."""
    return Path(shutil.copytree(load_robot("anymal_c").folder, folder))


# ---- files as tasks --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mine.yaml", "some/where/mine.yml"])
def test_a_yaml_file_is_a_task_by_its_name(show, name):
    written(name, f"extends: {TASK}\nsim: {{nconmax: 5}}\n")
    cfg = show("--task", name)
    assert (cfg.task, cfg.sim.nconmax) == ("mine", 5)


@pytest.mark.slow
def test_a_yaml_file_trains_and_its_run_lies_under_its_name():
    path = written("tasks/mine.yaml", f"extends: {TASK}\nrobot: ../robots/spotty\n")
    robot_at("robots/spotty")
    folder = tiny_run("--task", str(path))
    assert folder.parent == Path("logs/mine")
    assert from_dict(read_yaml(folder / "config.yaml")).robot == str(Path("robots/spotty").resolve())


@pytest.mark.slow
def test_a_policy_of_a_yaml_file_is_played_and_judged(capsys):
    written("mine.yaml", f"extends: {TASK}\n")
    tiny_run("--task", "mine.yaml")
    arguments = ["mine.yaml", "--sim-device", "cpu", "sim.threads=1"]
    assert call(evaluate_grid.main, [*arguments, "--vx=0", "--vy=0", "--yaw=0", "--robots", "1"]) == 0
    assert "logs/mine/" in capsys.readouterr().out


@pytest.mark.slow
def test_a_command_that_names_no_task_is_told_of_a_yaml_file_by_import(show, error, capsys):
    """As is one that names only the run of such a task."""
    written("mine.yaml", f"extends: {TASK}\nenv: {{num_envs: 7, episode_length_s: 0.4}}\n")
    assert show("--import", "mine.yaml", "--task", "mine").env.num_envs == 7
    assert "--import: there is no file 'none.yaml'" in error("--import", "none.yaml", "--task", TASK)
    registry._REGISTERED.clear()
    folder = tiny_run("--task", "mine.yaml")
    registry._REGISTERED.clear()
    flags = ["--import", "mine.yaml", str(folder), str(folder), "--episodes", "1", "--physics", "mujoco"]
    assert call(compare.main, flags) == 2, "episodes of 0.4 s are too short for statistics"
    assert "no episode of 'mine' is longer than 1 s" in capsys.readouterr().err


@pytest.mark.slow
def test_a_task_of_the_package_may_be_given_as_its_file(show):
    assert show("--task", str(registry.data_folder("cfg") / f"{TASK}.yaml")).task == TASK


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere.yaml", "there is no file 'nowhere.yaml'"),
        ("folder.yaml", "there is no file 'folder.yaml'"),
        (f"{TASK}.yaml", f"there is another task '{TASK}'"),
        (".hidden.yaml", "must be a plain name"),
        ("x" * 5000 + ".yaml", "there is no file"),
        ("x" * 5000, "there is no task"),
        ("../x", "there is no task '../x'"),
        ("a/b", "there is no task 'a/b'"),
        ("/etc/passwd", "there is no task '/etc/passwd'"),
        ("", "there is no task ''"),
        ("a\nb", "there is no task 'a\\nb'"),
    ],
)
def test_what_is_no_task_is_refused(error, name, words):
    Path("folder.yaml").mkdir()
    written(f"{TASK}.yaml", f"extends: {TASK}\n")
    written(".hidden.yaml", f"extends: {TASK}\n")
    text = error("--task", name)
    assert text.startswith("error: TASK: ")
    assert words in text
    assert len(text) < 1000


# ---- extends -------------------------------------------------------------------------------------------------------------


class Base(LeggedRobot):
    """A class with a reward of its own."""

    def _reward_nothing(self):
        return self.rew_buf * 0.0


@pytest.mark.slow
def test_a_registered_task_can_be_extended_from_code_and_from_a_file(show):
    registry.register("base", {"extends": TASK, "sim": {"nconmax": 9}, "rewards": {"scales": {"nothing": 1.0}}}, Base)
    registry.register("middle", {"extends": "base", "env": {"seed": 4}})
    written("mine.yaml", "extends: middle\ncommands: {small_command: 0.3}\n")
    cfg = show("--task", "mine.yaml")
    assert (cfg.sim.nconmax, cfg.env.seed, cfg.commands.small_command) == (9, 4, 0.3)
    assert registry.task_class("mine") is registry.task_class("middle") is Base  # else `nothing` would be unknown
    registry.register("other", {"extends": "base", "rewards": {"scales": {"nothing": 0.0}}}, LeggedRobot)
    with pytest.raises(ConfigError, match="LeggedRobot has no reward 'nothing'"):
        registry.task_config("other")


def test_a_mistake_in_an_extended_registered_task_is_blamed_on_it():
    registry.register("base", {"extends": TASK, "env": {"num_envs": 0}})
    registry.register("mine", {"extends": "base", "env": {"num_envs": 3}})
    with pytest.raises(ConfigError, match=r"^registered config of 'base': env\.num_envs: must be at least 1"):
        registry.task_config("mine")


def test_registered_tasks_that_extend_each_other_are_refused():
    registry.register("one", {"extends": "two"})
    registry.register("two", {"extends": "one"})
    with pytest.raises(ConfigError, match="extends: there is no task or file 'one'"):
        registry.task_config("one")


def test_a_registered_task_may_take_the_name_of_the_one_it_extends():
    registry.register(TASK, {"extends": TASK, "env": {"num_envs": 3}})
    assert registry.task_config(TASK).env.num_envs == 3


@pytest.mark.slow
@pytest.mark.parametrize("parent", ["[a]", "3", "''", "{a: b}", "x/y", "../x", '"a\\nb"', '"a\\0b"', "x" * 5000])
def test_what_cannot_be_extended_is_refused(error, parent):
    written("mine.yaml", f"extends: {parent}\n")
    assert "mine.yaml: extends: " in error("--task", "mine.yaml")


def test_a_long_chain_and_a_circle_by_a_detour_end(error):
    for i in range(30):
        written(f"c{i}.yaml", f"extends: c{i + 1}\n")
    assert "the chain of `extends` has more than 20 files" in error("--task", "c0.yaml")
    written("sub/file", "")
    written("one.yaml", "extends: sub/../one\n")
    assert "extends itself" in error("--task", "one.yaml")


# ---- robots --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["./robots/spotty", "robots/spotty", "../project/robots/spotty"])
def test_a_robot_is_found_beside_the_file_that_names_it(show, monkeypatch, tmp_path, robot):
    expected = str(robot_at("project/robots/spotty").resolve())
    written("project/mine.yaml", f"extends: {TASK}\nrobot: {robot}\n")
    written("elsewhere/child.yaml", "extends: ../project/mine\ncpu: {env: {num_envs: 3}}\n")
    assert show("--task", "project/mine.yaml").robot == expected
    monkeypatch.chdir("elsewhere")
    assert show("--task", "child.yaml").robot == expected  # of the file that sets it, not of the one that extends it
    monkeypatch.chdir("../project/robots")
    assert load_robot(show("--task", str(tmp_path / "project/mine.yaml")).robot).name == "spotty"


@pytest.mark.slow
def test_a_robot_in_the_cpu_section_is_too(show):
    expected = str(robot_at("project/spotty").resolve())
    written("project/mine.yaml", f"extends: {TASK}\ncpu: {{robot: ./spotty}}\n")
    assert show("--task", "project/mine.yaml").robot == expected


@pytest.mark.slow
def test_a_robot_on_the_command_line_is_relative_to_the_working_directory(show, error):
    expected = str(robot_at("spotty").resolve())
    assert show("--task", TASK, "robot=./spotty").robot == show("--task", TASK, "robot=spotty").robot == expected
    assert show("--task", TASK, "robot=anymal_c").robot == "anymal_c"
    message = error("--task", TASK, "robot=./other")
    assert "command line: robot: there is no robot" in message
    assert "that folder has no robot.yaml" in message
    assert "robot=FOLDER" in message


@pytest.mark.slow
def test_a_robot_of_a_registered_mapping_lies_beside_its_module(show, monkeypatch):
    expected = str(robot_at("project/spotty").resolve())
    module = f"import legged\nlegged.register('mine', {{'extends': '{TASK}', 'robot': './spotty'}})\n"
    written("project/my_tasks.py", module)
    assert show("--import", "project/my_tasks.py", "--task", "mine").robot == expected


def test_no_robot_at_all_is_said(error):
    written("mine.yaml", "env: {num_envs: 3}\n")
    assert "robot: the name of the robot is empty" in error("--task", "mine.yaml")


# ---- modules -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_module_finds_its_neighbours_and_its_files(show):
    written("project/neighbour.py", "COUNT = 7\n")
    written("project/mine.yaml", f"extends: {TASK}\nenv: {{seed: 8}}\n")
    module = "import legged\nfrom neighbour import COUNT\nlegged.register('mine', 'mine.yaml')\n"
    module += "legged.register('more', {'extends': 'mine', 'sim': {'nconmax': COUNT}})\n"
    written("project/my_tasks.py", module)
    cfg = show("--import", "project/my_tasks.py", "--task", "more")
    assert (cfg.sim.nconmax, cfg.env.seed) == (7, 8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import legged\n1 / 0\n", "line 2): ZeroDivisionError: division by zero"),
        ("def f():\n    raise KeyError('a')\n\n\nf()\n", "line 2): KeyError: 'a'"),
        ("x = = 3\n", "line 1): SyntaxError: invalid syntax"),
        ("\n\nimport no_such_thing\n", "line 3): ModuleNotFoundError: No module named 'no_such_thing'"),
        ("import sys\nsys.exit(3)\n", "line 2): SystemExit: 3"),
        ("raise ValueError('two\\nlines')\n", "line 1): ValueError: two lines"),
        ("import legged\nlegged.register('mine', 3)\n", "line 2): register('mine'): expected a YAML file or a mapping"),
        ("import legged\nlegged.register('a/b', {})\n", "line 2): register: the name of a task must be a plain name"),
        ("import legged\nlegged.register(3, {})\n", "line 2): register: the name of a task must be a plain name"),
        ("import legged\nlegged.register('mine', {}, int)\n", "line 2): register('mine'): expected a subclass"),
        ("import legged\nlegged.register('mine', {}, 'Mine')\n", "line 2): register('mine'): expected a subclass"),
    ],
)
@pytest.mark.parametrize("as_file", [True, False])
def test_a_module_that_fails_is_named_with_its_line(error, text, words, as_file):
    path = written("failing_tasks.py", text).resolve()
    name = "failing_tasks.py" if as_file else "failing_tasks"
    message = error("--import", name, "--task", "mine")
    assert message.startswith(f"error: --import: {name} ({path}, ")
    assert words in message
    assert error("--import", name, "--task", "mine") == message  # half of a module is not kept


def test_a_module_in_a_module_that_cannot_be_parsed_is_the_one_named(error):
    written("outer_tasks.py", "import inner_tasks\n")
    inner = written("inner_tasks.py", "def f(:\n").resolve()
    assert f"--import: outer_tasks.py ({inner}, line 1): SyntaxError" in error("--import", "outer_tasks.py", "--task", "x")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["no.such", ".relative", "/", "no.py/x.py", "x" * 5000, "x" * 5000 + ".py", "os.path.x", " "]
)
def test_what_is_no_module_is_refused(error, name):
    assert error("--import", name, "--task", TASK).startswith("error: --import: ")


def test_a_file_with_the_name_of_a_loaded_module_does_not_replace_it(error):
    import json

    written("json.py", "pass\n")
    assert "a module 'json' is loaded already" in error("--import", "json.py", "--task", TASK)
    assert sys.modules["json"] is json


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("{'extends': 'nothing_like'}", "registered config of 'mine': extends: there is no task or file 'nothing_like'"),
        (f"{{'extends': '{TASK}', 'custom': {{'a': object()}}}}", "custom.a: expected a number, a text"),
        (f"{{'extends': '{TASK}', 'env': {{1: 2}}}}", "env.1: unknown key 1"),
        ("'nowhere.yaml'", "nowhere.yaml: cannot be read"),
        ("''", "cannot be read (Is a directory)"),
    ],
)
def test_a_wrong_registered_configuration_is_named(error, config, words):
    written("my_tasks.py", f"import legged\nlegged.register('mine', {config})\n")
    assert words in error("--import", "my_tasks.py", "--task", "mine")


def test_an_observation_whose_width_changes_is_named():
    widths = iter([3, 3])

    class Odd(LeggedRobot):
        def _obs_odd(self):
            return self.commands[:, : next(widths, 2)]

    groups = {"actor": {"terms": ["odd", "dof_pos"]}, "critic": {"terms": ["dof_pos"]}}
    registry.register(
        "odd", {"extends": TASK, "observations": {"groups": groups}, "train": {"algorithm": {"symmetry": False}}}, Odd
    )
    cfg = registry.task_config("odd", [("env.num_envs", 4), *ENGINE], on_cpu=True)
    with pytest.raises(TermError, match=r"^_obs_odd: returned a tensor \(4, 2\), but \(4, 3\) in its first call"):
        registry.make_task(cfg)


def test_the_seed_is_that_of_python_and_numpy_too_and_torch_draws_as_before():
    def drawn(seed: int):
        small_task(("env.seed", seed))
        return random.random(), np.random.random(), torch.get_rng_state().tolist()

    with kept_generators(torch.device("cpu")):
        first, other, again = drawn(3), drawn(2**62), drawn(3)
        random.seed(5)
        assert drawn(3)[2] == first[2]
    assert first == again
    assert all(a != b for a, b in zip(first, other, strict=True))


def test_an_environment_of_gymnasium_leaves_the_generators_of_its_program_alone():
    with kept_generators(torch.device("cpu")):
        random.seed(7)
        np.random.seed(8)
        expected = random.Random(7).random(), np.random.RandomState(8).random_sample()
        TaskVectorEnv(TASK, 2, config=dict(ENGINE))
        assert (random.random(), np.random.random()) == expected
