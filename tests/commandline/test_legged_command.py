"""The command `legged`: its sub-commands, their help, what is misspelt, and the names of tasks and policies."""

import shlex
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from helpers import TASK, call, forget_modules_of, kept_global_state, run_folders, tiny_run

from legged import registry
from legged.cli import list as listing
from legged.cli.export import export
from legged.cli.main import COMMANDS, load, main, sub_commands
from legged.commandline.arguments import overrides
from legged.config import from_dict
from legged.config.loader import read_yaml
from legged.deploy.command_parser import CommandParser
from legged.registry import task_config, task_names

pytestmark = pytest.mark.usefixtures("workplace")
MODULES = sorted({place.partition(":")[0] for place, _ in COMMANDS.values()})
NEEDS_NOTHING = {"torch", "mujoco", "numpy", "yaml"}
"""Heavy packages that help and lists do without."""


# ---- commands and their help -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_shows_two_examples_that_it_can_read(name, capsys):
    parser = load(name).build_parser()
    assert isinstance(parser, CommandParser)
    assert parser.prog in (f"legged {name}", f"legged {name.partition(' ')[0]}")
    with pytest.raises(SystemExit) as stop:
        main([*name.split(), "--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out.partition("\nexamples:\n")[2].splitlines()
    assert len(shown) >= 2
    assert shown == [f"  {example}" for example in parser.examples]
    for example in parser.examples:
        assert f"{example} ".startswith(f"{parser.prog} ")
        words = shlex.split(example.partition(" > ")[0])
        args = parser.parse_intermixed_args(words[len(parser.prog.split()) :])
        task = getattr(args, "task", None)
        if name != "migrate":  # its tasks are those of legged_gym
            assert task is None or task in task_names()
            if task is not None and hasattr(args, "overrides"):
                task_config(task, overrides(args))  # its settings are ones of that task
        named = getattr(args, "policy", None)
        if isinstance(named, str) and not Path(named).is_relative_to("logs"):
            assert named.partition("/")[0] in task_names()


def test_every_module_of_the_commands_is_one():
    folder = Path(import_module("legged.cli").__file__).parent
    found = {".".join(("legged.cli", *path.relative_to(folder).with_suffix("").parts)) for path in folder.rglob("*.py")}
    modules = {name.removesuffix(".__init__") for name in found}
    assert modules - {"legged.cli", "legged.cli.main"} == set(MODULES)


def test_words_without_a_command_list_commands(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    for name, (_, summary) in COMMANDS.items():
        assert f"  {name} " in out
        assert summary in out
    assert main(["episodes"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[1] for line in lines] == sub_commands("episodes")


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--help"], ["-h"], [], ["list"], ["list", "robots"]])
def test_help_and_lists_import_nothing_heavy(words):
    command = [sys.executable, "-X", "importtime", "-m", "legged", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "legged.cli.main" in imported or "legged.cli" in imported
    assert not imported & NEEDS_NOTHING
    assert done.stdout


@pytest.mark.slow
def test_python_m_legged_is_the_installed_command(tmp_path):
    """The script that an installation makes calls `main` without arguments."""
    script = tmp_path / "bin" / "legged"
    script.parent.mkdir()
    script.write_text("import sys\nfrom legged.cli.main import main\nsys.exit(main())\n")
    for words in (["--help"], ["runs", "no_folder"]):
        given = ([sys.executable, "-m", "legged"], [sys.executable, str(script)])
        module, installed = (subprocess.run([*one, *words], capture_output=True, text=True, check=False) for one in given)
        assert (module.returncode, module.stdout, module.stderr) == (
            installed.returncode,
            installed.stdout,
            installed.stderr,
        )


def test_tasks_and_robots_are_listed(capsys):
    assert main(["list"]) == 0
    both = capsys.readouterr().out
    for words, names in ((["tasks"], listing.tasks()), (["robots"], listing.robots())):
        assert main(["list", *words]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines[1:]] == sorted(names)
        assert set(lines) <= set(both.splitlines())
    assert call(main, ["list", "robot"]) == 2
    assert "'robot'" in capsys.readouterr().err


# ---- what is misspelt ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["trian", TASK], ["'trian'", "did you mean 'train'?"]),
        (["fit_actuator"], ["'fit_actuator'", "did you mean 'fit-actuator'?"]),
        (["episodes", "recrod", TASK], ["legged episodes", "'recrod'", "did you mean 'record'?"]),
        (["deploy", "simm"], ["legged deploy", "'simm'", "did you mean 'sim'?"]),
        (["evaluate", "gird"], ["POLICY", "'gird'", "`legged evaluate grid`"]),
        (["evaluate", "terain", TASK], ["POLICY", "'terain'", "`legged evaluate terrain`"]),
        (["runs", "tabel"], ["tabel", "`legged runs table`"]),
        (["train", TASK, "--num-env", "3"], ["--num-env", "did you mean '--num-envs'?"]),
        (["evaluate", "grid", TASK, "--robot", "3"], ["--robot", "did you mean '--robots'?"]),
    ],
)
def test_the_nearest_word_is_named(words, said, capsys):
    assert call(main, words) == 2
    out, err = capsys.readouterr()
    for text in said:
        assert text in err
    assert out == ""
    assert "Traceback" not in err


def test_a_policy_that_is_not_there_is_no_sub_command(capsys):
    assert call(main, ["evaluate", "anymal_c_flatt"]) == 2
    err = capsys.readouterr().err
    assert f"did you mean '{TASK}'?" in err
    assert "`legged" not in err


# ---- names of tasks and policies -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with one run below logs/, its exported policies, and a task's YAML file with a run of its own."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        patch.setattr(registry, "_REGISTERED", {})
        Path("mine.yaml").write_text(f"extends: {TASK}\n")
        tiny_run("--task", "mine.yaml", num_envs=4, iterations=1)
        tiny_run(num_envs=4, iterations=1)
        (run,) = Path("logs", TASK).iterdir()
        assert call(export.main, [str(run), "--out", "exported"]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "experiment"),
    [
        (TASK, TASK),
        ("mine.yaml", "mine"),
        ("{run}", TASK),
        ("logs/{run}", TASK),
        ("{here}/logs/{run}", TASK),
        ("go2_flat", "go2_flat"),
    ],
)
def test_a_policy_is_named_in_all_ways(trained, monkeypatch, name, experiment):
    monkeypatch.chdir(trained)
    monkeypatch.setattr(registry, "_REGISTERED", {})
    (run,) = Path("logs", TASK).iterdir()
    found = []
    monkeypatch.setattr("legged.cli.evaluate.evaluate_following", lambda one, *_: found.append(one.policy) or 0)
    name = name.format(run=f"{TASK}/{run.name}", here=trained)
    assert call(main, ["evaluate", name, "--physics", "mujoco", "--out", str(trained / "out")]) == 0
    (one,) = found
    assert one.cfg.task == experiment
    shipped = experiment == "go2_flat"
    assert one.checkpoint.name == ("model.pt" if shipped else "model_0.pt")
    assert one.folder.parent.name == ("policies" if shipped else experiment)
    forget_modules_of(trained)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exported/00001", "exported/00001/policy.onnx"])
def test_an_exported_policy_is_named_by_its_folder_or_its_file(trained, monkeypatch, name):
    monkeypatch.chdir(trained)
    found = []
    monkeypatch.setattr(
        "legged.cli.evaluate.play", lambda robot, policy, *_: found.append((robot.name, policy.metadata)) or []
    )
    for words in (["evaluate", name], ["evaluate", "onnx", name]):
        assert call(main, words) == 0
    assert found[0] == found[1]
    assert found[0][0] == "anymal_c"


def test_what_names_no_policy_is_said_with_the_nearest_run(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    (run,) = Path("logs", TASK).iterdir()
    assert call(main, ["export", f"{TASK}/{run.name[:-1]}x"]) == 2
    assert f"error: POLICY: there is no task and no run '{TASK}/{run.name[:-1]}x'; did you mean" in capsys.readouterr().err
    assert call(main, ["export", "resources"]) == 2
    assert "error: POLICY: there is no task and no run 'resources'" in capsys.readouterr().err
    Path("nothing").mkdir(exist_ok=True)
    assert call(main, ["export", "nothing"]) == 2
    assert "error: POLICY: 'nothing' holds no run" in capsys.readouterr().err


def shown(capsys, *words: str):
    """The configuration that `legged train --show` prints."""
    assert call(main, ["train", *words, "--sim-device", "cpu", "--show"]) == 0
    Path("shown.yaml").write_text(capsys.readouterr().out)
    return from_dict(read_yaml(Path("shown.yaml")))


@pytest.mark.slow
def test_a_task_is_named_by_its_place_or_by_the_option_of_legged_gym(capsys):
    changes = ["env.num_envs=3", "env.seed=5"]
    wanted = shown(capsys, TASK, *changes)
    assert (wanted.task, wanted.env.num_envs, wanted.env.seed) == (TASK, 3, 5)
    assert shown(capsys, *changes, "--task", TASK) == wanted
    assert shown(capsys, changes[0], "--task", TASK, changes[1]) == wanted
    assert shown(capsys, "--task", TASK, "--num_envs", "3", "--seed=5") == wanted
    assert shown(capsys, TASK, "--task", TASK, *changes) == wanted


@pytest.mark.parametrize(("command", "name"), [("train", "TASK"), ("play", "POLICY")])
def test_two_names_or_none_are_refused(command, name, capsys):
    assert call(main, [command, TASK, "--task", "go2_flat"]) == 2
    assert f"--task: 'go2_flat' is given together with {name} '{TASK}'" in capsys.readouterr().err
    for words in ([], ["env.seed=3"]):
        assert call(main, [command, *words]) == 2
        assert f"error: {name}: is missing" in capsys.readouterr().err


def test_a_folder_with_an_equals_sign_is_no_override(trained, monkeypatch, tmp_path, capsys):
    (run,) = (trained / "logs" / TASK).iterdir()
    folder = tmp_path / "rate=0.1" / "run"
    shutil.copytree(run, folder)
    monkeypatch.chdir(tmp_path)
    assert call(main, ["play", "./rate=0.1/run", "--checkpoint", "7", "--sim-device", "cpu"]) == 2
    assert "rate=0.1/run has no checkpoint 7 (it has: 0)" in capsys.readouterr().err


@pytest.mark.slow
def test_play_names_a_run_of_the_task_by_the_options_of_legged_gym(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    (run,) = [folder for folder in run_folders() if folder.parent.name == TASK]
    for words in (["--load_run", run.name], ["--load-run", str(run)], ["--experiment_name", TASK]):
        assert call(main, ["play", "--task", TASK, *words, "--checkpoint", "7", "--sim_device", "cpu"]) == 2
        assert f"{run} has no checkpoint 7" in capsys.readouterr().err
    assert call(main, ["play", "--task", "go2_flat", "--load_run", str(run)]) == 2
    assert f"--load-run: {run} was trained on '{TASK}', not on 'go2_flat'" in capsys.readouterr().err
