"""Which run a live view shows, and which checkpoint of it."""

import argparse
import os
import shutil
from pathlib import Path

import pytest
from helpers import POLICY, TASK

from legged import registry
from legged.errors import ConfigError
from legged.learning.run_folder import BEST, BEST_MODEL, CONFIG_FILE, SHIPPED_MODEL
from legged.play.live.source import CheckpointFollower, Watched, find_watched

pytestmark = pytest.mark.usefixtures("workplace")


def asked(
    task: str | None = None, load_run: str | None = None, checkpoint: int | str | None = None, experiment: str | None = None
):
    """What a command line asks for."""
    flags = {"task": task, "load_run": load_run, "checkpoint": checkpoint, "experiment_name": experiment}
    return find_watched(argparse.Namespace(**flags, overrides=[], solver=None))


def begin(name: str, *checkpoints: int, when: float) -> Path:
    """Make a run folder below logs/ whose files are `when` [s] old."""
    folder = Path("logs") / name
    folder.mkdir(parents=True)
    shutil.copy(POLICY / CONFIG_FILE, folder)
    for iteration in checkpoints:
        shutil.copy(POLICY / SHIPPED_MODEL, folder / f"model_{iteration}.pt")
    now = folder.stat().st_mtime
    for path in folder.iterdir():
        os.utime(path, (now - when, now - when))
    return folder


def test_the_newest_run_of_all_is_shown_also_while_it_has_no_checkpoint():
    with pytest.raises(ConfigError, match=r"--load_run: there is no run in logs; train one first, or name a task"):
        asked()
    older = begin(f"{TASK}/older", 0, 50, when=1000.0)
    assert asked().folder == older
    other = begin("other/middle", 10, when=500.0)
    young = begin(f"{TASK}/young", when=100.0)
    assert asked().folder == young
    assert asked(experiment="other").folder == other
    assert asked(task=TASK, experiment="other").folder == other
    os.utime(older / "model_50.pt")  # it goes on
    assert asked().folder == older


def test_a_task_without_a_run_shows_its_shipped_policy(monkeypatch):
    assert asked(task=TASK).folder == POLICY
    run = begin(f"{TASK}/run", 50, when=1.0)
    assert asked(task=TASK).folder == run
    monkeypatch.setattr(registry, "_REGISTERED", {})
    registry.register("untrained", {"extends": TASK})
    with pytest.raises(ConfigError, match="there is no run in logs/untrained; train one first"):
        asked(task="untrained")


@pytest.mark.parametrize("name", ["logs/{0}/run", "{0}/run", "run"])
def test_a_run_is_named_by_its_path_or_its_name(name):
    run = begin(f"{TASK}/run", 50, when=1.0)
    begin(f"{TASK}/newer", 50, when=0.0)
    assert asked(load_run=name.format(TASK)).folder.resolve() == run.resolve()
    assert asked(load_run=name.format(TASK)).cfg.task == TASK


def test_a_shipped_policy_is_named_by_its_task():
    begin(f"{TASK}/run", 50, when=1.0)
    for name in (TASK, f"resources/policies/{TASK}", str(POLICY)):
        assert asked(load_run=name).folder.resolve() == POLICY


def test_wrong_names_are_said_with_the_nearest_one():
    begin(f"{TASK}/2026-01-01_run", 50, when=1.0)
    with pytest.raises(ConfigError, match=rf"there is no run '2026-01-02_run'.*{TASK}/2026-01-01_run"):
        asked(load_run="2026-01-02_run")
    with pytest.raises(ConfigError, match=f"was trained on '{TASK}', not on 'go2_flat'"):
        asked(task="go2_flat", load_run=f"logs/{TASK}/2026-01-01_run")
    with pytest.raises(ConfigError, match=r"has no checkpoint 7 \(it has: 50\)"):
        asked(load_run="2026-01-01_run", checkpoint=7)
    assert asked(load_run="2026-01-01_run", checkpoint=50).checkpoint == 50
    assert asked(load_run="2026-01-01_run", checkpoint=-1).checkpoint is None


def test_a_checkpoint_is_given_once_and_again_when_it_was_written_anew():
    run = begin(f"{TASK}/run", 50, when=100.0)
    follower = CheckpointFollower(Watched(asked().cfg, run))
    assert follower.changed() == run / "model_50.pt"
    assert follower.changed() is None
    follower.forget()
    assert follower.changed() == run / "model_50.pt"
    shutil.copy(POLICY / SHIPPED_MODEL, run / "model_100.pt")
    assert follower.changed() == run / "model_100.pt"
    (run / "model_100.pt").unlink()
    assert follower.changed() == run / "model_50.pt"
    follower.choice = BEST  # there is none yet
    assert follower.changed() is None
    shutil.copy(POLICY / SHIPPED_MODEL, run / BEST_MODEL)
    assert follower.changed() == run / BEST_MODEL
    os.utime(run / BEST_MODEL, (1.0, 1.0))
    assert follower.changed() == run / BEST_MODEL
    shutil.rmtree(run)
    assert follower.changed() is None


def test_the_best_checkpoint_can_be_asked_for_and_is_followed():
    run = begin(f"{TASK}/run", 50, when=100.0)
    with pytest.raises(ConfigError, match=r"has no model_best\.pt"):
        asked(checkpoint="best")
    shutil.copy(POLICY / SHIPPED_MODEL, run / BEST_MODEL)
    follower = CheckpointFollower(asked(checkpoint="best"))
    assert follower.changed() == run / BEST_MODEL
    os.utime(run / BEST_MODEL, (1.0, 1.0))  # the training has found a better one
    assert follower.changed() == run / BEST_MODEL
    assert follower.has_best  # and the page offers the newest, too
