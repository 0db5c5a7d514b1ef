"""Damaged and foreign checkpoints and states: refused in a line, or loaded with finite weights; nothing in them is run."""

import shutil
from pathlib import Path

import pytest
import torch
from draws import HOW, VALUES, mutated, places
from helpers import TASK
from hypothesis import given
from hypothesis import strategies as st
from outcomes import refused_in_a_line

from legged.cli.play import play
from legged.cli.train import train
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.run_folder import run_config
from legged.learning.runner import Runner
from legged.learning.transfer import check_source
from legged.policies.restore import TrainedPolicy, restore
from legged.registry import make_task

pytestmark = pytest.mark.slow

TENSORS = st.sampled_from(
    [
        torch.zeros(0),
        torch.zeros(3),
        torch.full((8, 48), float("nan")),
        torch.tensor(1),
        torch.zeros(2, 2, dtype=torch.long),
        torch.ones(8, 48, dtype=torch.float64),
        torch.zeros(8, 48, dtype=torch.bool),
        torch.zeros(1).expand(8, 48),
    ]
)
ANYTHING = st.one_of(VALUES, TENSORS)


def load(folder: Path, name: str) -> None:
    """As every command does that loads a policy; and as training does that goes on."""
    path = folder / name
    cfg = run_config(folder)
    saved = read_checkpoint(path)
    check_fits(path, saved, cfg)
    runner = Runner(make_task(cfg))
    runner.resume(str(path))
    assert runner.current_learning_iteration >= 0
    for model in (runner.alg.actor, runner.alg.critic):
        assert all(torch.isfinite(tensor).all() for tensor in model.state_dict().values())
    observations = runner.env.get_observations()
    assert torch.isfinite(runner.alg.get_policy()(observations)).all()
    runner.env.step(torch.zeros(runner.env.num_envs, runner.env.num_actions))


def begin_with(folder: Path, name: str) -> None:
    """As training does that begins with another one's networks."""
    path = folder / name
    cfg = run_config(folder)
    check_source(path, read_checkpoint(path), cfg)
    runner = Runner(make_task(cfg))
    assert runner.transfer(str(path)).startswith("took from")
    assert runner.current_learning_iteration == 0
    for model in (runner.alg.actor, runner.alg.critic):
        assert all(torch.isfinite(tensor).all() for tensor in model.state_dict().values())


def act_by(folder: Path, name: str) -> None:
    """As playing and evaluating do."""
    task, act = restore(TrainedPolicy(run_config(folder), folder / name), [], torch.device("cpu"))
    assert torch.isfinite(act(task.get_observations())).all()


@given(data=st.data(), how=HOW, value=ANYTHING, use=st.sampled_from([begin_with, act_by]))
def test_a_changed_part_of_a_checkpoint_that_others_begin_with(data, how, value, use, trained, in_new_folder):
    content = torch.load(trained / "model_1.pt", weights_only=True)
    path = data.draw(st.sampled_from(places(content)))
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "run")
        torch.save(mutated(content, path, how, value), folder / "run" / "model_1.pt")
        with refused_in_a_line():
            use(folder / "run", "model_1.pt")


@given(data=st.data(), how=HOW, value=ANYTHING, of=st.sampled_from(["model_1.pt", "state_1.pt"]))
def test_a_changed_part_of_a_checkpoint(data, how, value, of, trained, in_new_folder):
    content = torch.load(trained / of, weights_only=True)
    path = data.draw(st.sampled_from(places(content)))
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "run")
        torch.save(mutated(content, path, how, value), folder / "run" / of)
        with refused_in_a_line():
            load(folder / "run", "model_1.pt")


@given(data=st.data(), of=st.sampled_from(["model_1.pt", "state_1.pt"]))
def test_flipped_and_missing_bytes(data, of, trained, in_new_folder):
    content = bytearray((trained / of).read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    content = content[: data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))]
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "run")
        (folder / "run" / of).write_bytes(bytes(content))
        with refused_in_a_line():
            load(folder / "run", "model_1.pt")


class Runs:
    """A pickle of this touches a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@given(data=st.data(), of=st.sampled_from(["model_1.pt", "state_1.pt"]), old=st.booleans())
def test_code_in_any_place_is_not_run(data, of, old, trained, in_new_folder, run):
    content = torch.load(trained / of, weights_only=True)
    path = data.draw(st.sampled_from(places(content)))
    with in_new_folder() as folder:
        runs = folder / "logs" / TASK / "run"
        shutil.copytree(trained, runs)
        evil = mutated(content, path, "replace", Runs(folder / "it_ran"))
        torch.save(evil, runs / of, _use_new_zipfile_serialization=not old)
        base = ["--task", TASK, "--sim_device", "cpu", "--load_run", "run"]
        main, more = data.draw(
            st.sampled_from([(train.main, ["--resume", "--max_iterations", "3"]), (play.main, ["--no-video"])])
        )
        run(main, [*base, *more])
        assert not (folder / "it_ran").exists()


@given(data=st.data(), how=HOW, value=VALUES)
def test_a_changed_configuration_of_a_run(data, how, value, trained, in_new_folder, run):
    import yaml

    content = yaml.safe_load((trained / "config.yaml").read_text())
    path = data.draw(st.sampled_from(places(content)))
    with in_new_folder() as folder:
        runs = folder / "logs" / TASK / "run"
        shutil.copytree(trained, runs)
        text = yaml.safe_dump(mutated(content, path, how, value), allow_unicode=True)
        (runs / "config.yaml").write_text(text, encoding="utf-8")
        small = ["env.num_envs=4", "train.runner.num_steps_per_env=4"]
        run(train.main, ["--task", TASK, "--sim_device", "cpu", "--load_run", "run", "--resume", "--show", *small])
