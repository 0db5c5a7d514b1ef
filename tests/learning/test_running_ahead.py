"""On a GPU an iteration is launched before the last one is logged: the same is learned and written as in step. Here the order
of things is tested on the CPU, which has no reason for it.
"""

from pathlib import Path

import pytest
import torch
from helpers import checkpoints, small_task, tiny_run

from legged.evaluation.learning_curves import read_scalars
from legged.learning.async_readback import AsyncReadback
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import read_checkpoint
from legged.learning.divergence import Diverged
from legged.learning.rollout import Rollout

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.fixture
def ahead(monkeypatch) -> None:
    monkeypatch.setattr(CapturedRunner, "_runs_ahead", True)


@pytest.fixture
def order(monkeypatch) -> list[str]:
    """What a training does: `go` at a rollout, `log 3` when iteration 3 is logged, `save`."""
    done: list[str] = []
    collect, log, save = Rollout.collect, CapturedRunner._log, CapturedRunner.save

    def collects(self, steps=None):
        if steps is None:  # else it rehearses
            done.append("go")
        collect(self, steps)

    def logs(self, made):
        done.append(f"log {made.iteration}")
        log(self, made)

    def saves(self, path, infos=None):
        done.append("save")
        save(self, path, infos)

    monkeypatch.setattr(Rollout, "collect", collects)
    monkeypatch.setattr(CapturedRunner, "_log", logs)
    monkeypatch.setattr(CapturedRunner, "save", saves)
    return done


def runner_of(folder: Path, save_interval: int = 100) -> CapturedRunner:
    folder.mkdir()
    short = [("train.runner.num_steps_per_env", 4), ("train.runner.save_interval", save_interval)]
    return CapturedRunner(small_task(*short), folder, "cpu")


@pytest.mark.slow
def test_an_iteration_is_logged_while_the_next_one_is_computed(ahead, order):
    """In step are: the first, whose numbers show that all is well; those with a checkpoint; the last two."""
    assert runner_of(Path("run"), save_interval=4).train(8)
    assert order == [
        *("go", "log 0", "save", "go", "go", "log 1", "go", "log 2", "go", "log 3", "log 4", "save"),
        *("go", "go", "log 5", "log 6", "go", "log 7", "save"),
    ]


@pytest.mark.slow
def test_without_that_each_is_logged_at_once(order):
    assert runner_of(Path("run")).train(3)
    assert order == ["go", "log 0", "save", "go", "log 1", "go", "log 2", "save"]


@pytest.mark.slow
def test_what_is_learned_and_logged_is_the_same(ahead, monkeypatch):
    evaluated = ["train.runner.evaluate_interval=4", "train.runner.evaluate_envs=4", "train.runner.evaluate_share=1"]
    settings = ["train.runner.save_interval=3", "env.episode_length_s=0.1", *evaluated]
    folders = [tiny_run(*settings, iterations=7)]
    monkeypatch.setattr(CapturedRunner, "_runs_ahead", False)
    folders.append(tiny_run(*settings, iterations=7))
    scalars = [read_scalars(folder) for folder in folders]
    assert scalars[0].keys() == scalars[1].keys()
    assert scalars[0]["Evaluation/lin_vel_rmse"][0].tolist() == [3, 6]
    for name in scalars[0].keys() - {"Perf/total_fps", "Perf/collection_time", "Perf/learning_time"}:
        if name.endswith("/time"):
            continue
        both = [[column.tolist() for column in found[name]] for found in scalars]
        assert both[0] == both[1], name
    ends = [read_checkpoint(folder / "model_6.pt") for folder in folders]
    for network in ("actor_state_dict", "critic_state_dict"):
        for name, weights in ends[0][network].items():
            assert torch.equal(weights, ends[1][network][name]), name


@pytest.mark.slow
def test_who_asks_to_stop_gets_everything_logged_that_was_learned(ahead, order, monkeypatch):
    runner = runner_of(Path("run"))
    log = runner.logger.log

    def ask(it, *rest, **named):
        if it == 2:
            runner.stop()
        log(it, *rest, **named)

    monkeypatch.setattr(runner.logger, "log", ask)
    assert not runner.train(9)
    assert order == ["go", "log 0", "save", "go", "go", "log 1", "go", "log 2", "log 3", "save"]
    assert checkpoints(Path("run")) == [0, 3]
    assert runner.logger.tot_timesteps == 4 * runner.logger.steps_per_iteration


@pytest.mark.slow
def test_a_training_that_can_not_go_on_names_the_iteration_that_says_so(ahead, monkeypatch):
    runner = runner_of(Path("run"))
    judged = []

    def update(_values, _left_out):
        judged.append(1)
        runner.logger.divergence.why_stop = "all is lost" if len(judged) == 3 else ""

    monkeypatch.setattr(runner.logger.divergence, "update", update)
    with pytest.raises(Diverged, match=r"stopped after iteration 3: all is lost; the last checkpoint is run/model_0\.pt"):
        runner.train(9)


def test_a_readback_has_the_numbers_of_the_moment_it_was_made():
    lengths, counts = torch.tensor([1.5, 2.5]), torch.tensor([[3, 4], [5, 6]])
    readback = AsyncReadback({"lengths": lengths, "counts": counts, "one": lengths.sum()})
    lengths.zero_()
    counts.zero_()
    assert readback.numbers() == {"lengths": [1.5, 2.5], "counts": [3.0, 4.0, 5.0, 6.0], "one": [4.0]}
    assert readback.numbers()["one"] == [4.0]
