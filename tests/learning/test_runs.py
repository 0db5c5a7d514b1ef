"""Run folders: whose they are, what is written into them, and when there is none."""

import errno
import os
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, run_folders, small_config, tiny_run

import legged.cli.train
from legged.cli.train import train
from legged.errors import ConfigError, RunError
from legged.evaluation.reports.record import folders_in
from legged.learning import run_folder as runs
from legged.learning.run_folder import checkpoints, code_state, create_run, discard_run, find_checkpoint, run_config
from legged.mdp.actuators.network import NetworkWeights
from legged.policies.restore import TrainedPolicy

pytestmark = pytest.mark.usefixtures("workplace")

ARGUMENTS = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "1", *TINY_TRAINING]


@pytest.mark.slow
def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(monkeypatch):
    monkeypatch.setattr(runs, "stamped", lambda _: "2026-01-01_00-00-00")
    monkeypatch.setattr(runs, "code_state", lambda: "")
    made: list[Path] = []
    threads = [threading.Thread(target=lambda: made.append(create_run(small_config()))) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    names = {folder.name for folder in made}
    assert names == {"2026-01-01_00-00-00", *(f"2026-01-01_00-00-00-{i}" for i in range(2, 13))}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("train.runner.experiment_name=../elsewhere", "experiment_name: expected a plain name"),
        ("train.runner.experiment_name=/tmp/elsewhere", "got '/tmp/elsewhere'"),
        ("train.runner.experiment_name=a/../../b", "got 'a/../../b'"),
        ("train.runner.run_name=a/b", "command line: train.runner.run_name: expected a plain name"),
        (f"train.runner.run_name={'long' * 70}", "at most 100 letters"),
    ],
)
def test_names_that_are_paths_are_refused_before_anything_is_built(override, words, monkeypatch, capsys):
    monkeypatch.setattr(legged.cli.train, "make_task", lambda *_, **__: pytest.fail("built"))
    assert call(train.main, [*ARGUMENTS, override]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.splitlines()) == 1
    assert not Path("logs").exists()


def test_a_failed_start_leaves_no_folder(monkeypatch):
    def fail(*_args, **_kwargs):
        assert not Path("logs").exists()
        raise KeyError("while building")

    monkeypatch.setattr(legged.cli.train, "make_task", fail)
    with pytest.raises(KeyError):
        train.main(ARGUMENTS)
    assert not Path("logs").exists()


@pytest.mark.slow
def test_a_first_iteration_that_fails_leaves_no_folder_and_a_later_one_its_checkpoints(monkeypatch):
    runner = (
        legged.cli.train.CapturedRunner if "captured" in str(small_config().train.runner.loop) else legged.cli.train.Runner
    )
    save, saved = runner.save, []

    def save_once(self, path, infos=None):
        if saved:
            raise OSError(28, "No space left on device")
        saved.append(path)
        save(self, path, infos)

    monkeypatch.setattr(runner, "save", save_once)
    arguments = [*ARGUMENTS, "--max_iterations", "3", "train.runner.save_interval=1"]
    assert train.main(arguments) == 1
    (folder,) = run_folders()
    assert list(checkpoints(folder)) == [0]
    assert train.main(arguments) == 1
    assert run_folders() == [folder]


def test_a_first_checkpoint_that_finds_no_room_leaves_no_folder(monkeypatch, capsys):
    """The state of the robots, which is written before it, found some."""

    def full(path, _content):
        assert [found.name for found in path.parent.glob("*.pt")] == ["state_0.pt"]
        raise RunError(f"{path}: no space left on the disk")

    monkeypatch.setattr("legged.learning.runner.write_checkpoint", full)
    assert train.main(ARGUMENTS) == 1
    assert not Path("logs").exists()
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_folder_with_something_else_in_it_is_not_discarded():
    cfg = small_config()
    first, second = create_run(cfg), create_run(cfg)
    (first / "notes.txt").write_text("mine")
    discard_run(first)
    discard_run(second)
    assert [path.name for path in first.iterdir()] == ["notes.txt"]
    assert not second.exists()


@pytest.mark.parametrize("room", [0, 2**20])
def test_a_full_disk_is_seen_before_anything_is_built(room, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(2**30, 2**30 - room, room))
    monkeypatch.setattr(legged.cli.train, "make_task", lambda *_, **__: pytest.fail("built"))
    assert train.main(ARGUMENTS) == 1
    assert capsys.readouterr().err == f"error: logs/{TASK}: cannot write there: no space left on the disk\n"


def test_a_full_disk_at_a_checkpoint_is_called_that(monkeypatch):
    from legged.learning.checkpoint import load_plain, write_checkpoint

    saved = {"actor_state_dict": {}, "critic_state_dict": {}, "iter": 3, "extra": torch.zeros(9)}
    write_checkpoint(Path("model_3.pt"), saved)
    real = Path.write_bytes

    def full(self, data):
        real(self, bytes(data)[:64])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(RunError, match=r"model_3\.pt: no space left on the disk"):
        write_checkpoint(Path("model_3.pt"), {**saved, "iter": 4})
    assert load_plain(Path("model_3.pt"))["iter"] == 3
    assert [path.name for path in Path.cwd().iterdir()] == ["model_3.pt"]


# ---- checkpoints -----------------------------------------------------------------------------------------------------


def test_folders_and_links_that_lead_nowhere_are_no_checkpoints():
    folder = Path("run")
    (folder / "model_5.pt").mkdir(parents=True)
    (folder / "model_7.pt").symlink_to("gone.pt")
    assert checkpoints(folder) == {}
    with pytest.raises(ConfigError, match="run: holds no checkpoint"):
        find_checkpoint(folder, None)
    (folder / "model_3.pt").write_bytes(b"")
    assert list(checkpoints(folder)) == [3]
    with pytest.raises(ConfigError, match=r"has no checkpoint 5 \(it has: 3\)"):
        find_checkpoint(folder, 5)


# ---- the hint at the end ---------------------------------------------------------------------------------------------


def hint(out: str) -> str:
    return out.rpartition("see it walk: ")[2].strip()


def test_the_hint_names_everything_that_play_needs(capsys):
    Path("my tasks.py").write_text(f"import legged\nlegged.register('mine', {{'extends': '{TASK}'}})\n")
    arguments = ["--task", "mine", "--import", "my tasks.py", "--experiment_name", "second try", "--run_name", "[x]"]
    assert train.main([*ARGUMENTS[2:], *arguments]) == 0
    (folder,) = run_folders()
    expected = f"legged play --import 'my tasks.py' '{folder}'"
    assert hint(capsys.readouterr().out) == expected


@pytest.mark.slow
def test_the_hint_names_the_run_where_it_is_not_the_newest(monkeypatch, capsys):
    other = tiny_run("--run_name", "other", iterations=1)
    monkeypatch.setattr(legged.cli.train, "find_run", lambda *_: other)
    assert train.main([*ARGUMENTS, "--run_name", "this"]) == 0
    (this,) = [folder for folder in run_folders() if folder.name.endswith("_this")]
    assert hint(capsys.readouterr().out) == f"legged play {this}"


# ---- the state of the code -------------------------------------------------------------------------------------------


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """installed(project, tracked): a git repository with a package at its top level, whose code_state is asked for."""

    def install(project: str, tracked: bool, below: str = ".") -> str:
        top = tmp_path / "repository"
        package = top / below / "legged" / "learning"
        package.mkdir(parents=True)
        for path, text in (
            (package.parent / "__init__.py", "old\n"),
            (package / "runs.py", ""),
            (top / below / "pyproject.toml", f"[project]\nname = '{project}'\n"),
            (top / "secrets.py", "password = ''\n"),
        ):
            path.write_text(text)

        def git(*arguments: str) -> None:
            command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
            subprocess.run(command, cwd=top, check=True, capture_output=True)

        git("init")
        git("add", *(["."] if tracked else ["secrets.py"]))
        git("commit", "-m", "first")
        (top / "secrets.py").write_text("password = 'hunter2'\n")
        (top / "untracked.txt").write_text("not to be copied\n")
        monkeypatch.setattr(runs, "__file__", str(package / "runs.py"))
        return code_state()

    if shutil.which("git") is None:
        pytest.skip("needs git")
    return install


def test_the_projects_own_repository_is_written_down(installed):
    said = installed("legged", tracked=True)
    assert "\ncommit " in said
    assert "+password = 'hunter2'" in said  # a file of this project
    assert "?? untracked.txt" in said
    assert "not to be copied" not in said


@pytest.mark.parametrize(
    "place",
    [
        {"project": "legged", "tracked": False},  # unpacked into somebody's repository
        {"project": "their_robots", "tracked": True},  # a copy in somebody's repository
        {"project": "legged", "tracked": True, "below": "venv/site-packages"},
    ],
)
def test_somebody_elses_repository_is_not(installed, place):
    said = installed(**place)
    assert said.splitlines()[1:] == ["not in a git repository of its own"]


def test_without_git_that_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert code_state().splitlines()[1:] == ["git is not on the PATH, so the commit is unknown"]


@pytest.mark.parametrize("closed", [f"logs/{TASK}", "logs"])
def test_a_folder_of_runs_that_cannot_be_read_does_not_lead_to_the_shipped_policy(monkeypatch, closed):
    """A user who may read everything finds no closed folder, so the system's answer is made up."""
    entries = os.listdir

    def listdir(folder):
        if str(folder).startswith(closed):
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return entries(folder)

    monkeypatch.setattr(os, "listdir", listdir)
    for find in (lambda: runs.run_named(TASK, "POLICY"), lambda: runs.find_run(small_config(), None)):
        with pytest.raises(RunError, match=rf"^logs/{TASK}: the folder can't be read: Permission denied$"):
            find()
    for find in (lambda: runs.newest_run("POLICY"), lambda: folders_in(Path("logs"))):
        with pytest.raises(RunError if closed == "logs" else ConfigError):
            find()
    monkeypatch.setattr(os, "listdir", entries)
    assert runs.run_named(TASK, "POLICY") == runs.shipped_policy(TASK)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["", " ", "long" * 100, "zero\0byte", "../..", "*"])
def test_a_run_of_an_odd_name_is_not_there(name):
    tiny_run(iterations=1)
    with pytest.raises(ConfigError, match="there is no run") if name != "../.." else pytest.raises(ConfigError):
        runs.run_config(runs.find_run(small_config(), name))


@pytest.mark.slow
def test_a_run_keeps_the_network_of_its_motors(tmp_path):
    """Its file may be moved or fitted anew; the run is restored from its own folder, wherever that is put."""
    rng = np.random.default_rng(5)
    layers = [{"weight": rng.normal(size=shape), "bias": rng.normal(size=shape[0])} for shape in ((8, 4), (1, 8))]
    NetworkWeights("mlp", 0.005, 2, np.array([2.0, 0.2, 20.0]), tuple(layers)).save(tmp_path / "net.npz")
    folder = tiny_run(f"control.actuator.network={tmp_path / 'net.npz'}", iterations=1)
    (tmp_path / "net.npz").unlink()
    moved = folder.rename(tmp_path / "elsewhere")
    assert "network: motors.npz" in (moved / "config.yaml").read_text()
    cfg = run_config(moved)
    assert cfg.control.actuator.network == str(moved / "motors.npz")
    TrainedPolicy(cfg, find_checkpoint(moved, None))
    discard_run(moved)
    assert (moved / "motors.npz").is_file()
    for checkpoint in moved.glob("model_*.pt"):
        checkpoint.unlink()
    discard_run(moved)
    assert not (moved / "motors.npz").exists()
