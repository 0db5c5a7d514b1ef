"""Which run a live view shows, and which checkpoint of it."""

import os
import shutil
from pathlib import Path

import pytest
from helpers import POLICY, TASK

from legged import registry
from legged.errors import ConfigError
from legged.learning.run_folder import BEST, BEST_MODEL, CONFIG_FILE, SHIPPED_MODEL
from legged.play.live.session import Watched, find_watched

pytestmark = pytest.mark.usefixtures("workplace")


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
    with pytest.raises(ConfigError, match=r"POLICY: there is no run in logs/; train one first, or name a task"):
        find_watched(None, None)
    older = begin(f"{TASK}/older", 0, 50, when=1000.0)
    assert find_watched(None, None).folder == older
    other = begin("other/middle", 10, when=500.0)
    young = begin(f"{TASK}/young", when=100.0)
    assert find_watched(None, None).folder == young
    assert find_watched("other", None).folder == other
    os.utime(older / "model_50.pt")  # it goes on
    assert find_watched(None, None).folder == older


def test_a_task_without_a_run_shows_its_shipped_policy(monkeypatch):
    assert find_watched(TASK, None).folder == POLICY
    run = begin(f"{TASK}/run", 50, when=1.0)
    assert find_watched(TASK, None).folder == run
    monkeypatch.setattr(registry, "_REGISTERED", {})
    registry.register("untrained", {"extends": TASK})
    with pytest.raises(
        ConfigError, match="POLICY: 'untrained' has neither a run in logs/untrained nor a shipped policy; train it first"
    ):
        find_watched("untrained", None)


@pytest.mark.parametrize("name", ["logs/{0}/run", "{0}/run", "./logs/{0}/run/"])
def test_a_run_is_named_by_its_path_or_its_name(name):
    run = begin(f"{TASK}/run", 50, when=1.0)
    begin(f"{TASK}/newer", 50, when=0.0)
    assert find_watched(name.format(TASK), None).folder.resolve() == run.resolve()
    assert find_watched(name.format(TASK), None).cfg.task == TASK


def test_a_shipped_policy_is_named_by_its_task():
    for name in (TASK, f"resources/policies/{TASK}", str(POLICY)):
        assert find_watched(name, None).folder.resolve() == POLICY


def test_wrong_names_are_said_with_the_nearest_one():
    begin(f"{TASK}/2026-01-01_run", 50, when=1.0)
    with pytest.raises(ConfigError, match=rf"no run '{TASK}/2026-01-02_run'; did you mean '{TASK}/2026-01-01_run'"):
        find_watched(f"{TASK}/2026-01-02_run", None)
    with pytest.raises(ConfigError, match=r"has no checkpoint 7 \(it has: 50\)"):
        find_watched(f"{TASK}/2026-01-01_run", 7)
    assert find_watched(f"{TASK}/2026-01-01_run", 50).checkpoint == 50
    assert find_watched(f"{TASK}/2026-01-01_run", -1).checkpoint is None


def test_a_checkpoint_is_given_once_and_again_when_it_was_written_anew():
    run = begin(f"{TASK}/run", 50, when=100.0)
    follower = Watched(find_watched(None, None).cfg, run)
    assert follower.changed() == run / "model_50.pt"
    assert follower.changed() is None
    follower.shown = None
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
        find_watched(None, "best")
    shutil.copy(POLICY / SHIPPED_MODEL, run / BEST_MODEL)
    follower = find_watched(None, "best")
    assert follower.changed() == run / BEST_MODEL
    os.utime(run / BEST_MODEL, (1.0, 1.0))  # the training has found a better one
    assert follower.changed() == run / BEST_MODEL
    assert follower.has_best  # and the page offers the newest, too
