"""Trainings that go on with drawn changes: refused in a line, or going on with finite weights; two halves are a whole."""

import shutil
from pathlib import Path

import pytest
import torch
from draws import OVERRIDES
from helpers import TASK, checkpoints, run_folders
from hypothesis import given
from hypothesis import strategies as st

from legged.cli.play import play
from legged.cli.train import train
from legged.learning.run_folder import run_config

pytestmark = pytest.mark.slow

SMALL = ["sim.threads=1", "train.runner.num_steps_per_env=4", "train.runner.report=false"]
NUMBER = st.sampled_from([1, 2, 3, 5, 7, 12])


def text_of(value) -> str:
    """A value as YAML on one line."""
    import yaml

    return yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("...\n").strip()


@given(overrides=OVERRIDES, iterations=st.integers(1, 4), robots=st.sampled_from([None, 1, 4, 6]))
def test_going_on_with_changes(overrides, iterations, robots, trained, run, in_new_folder):
    """Whatever is changed on the command line; sizes stay small."""
    heavy = {"env.num_envs", "train.runner.num_steps_per_env", "control.decimation", "sim.iterations", "sim.ls_iterations"}
    heavy |= {"train.algorithm.num_learning_epochs", "train.algorithm.num_mini_batches", "domain_rand.friction_buckets"}
    heavy |= {"terrain.mesh_type", "train.runner.experiment_name", "train.runner.report"}
    heavy |= {"train.runner.evaluate_interval", "train.runner.evaluate_envs", "train.runner.evaluate_s"}
    changes = [f"{path}={text_of(value)}" for path, value in overrides if path not in heavy]
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "logs" / TASK / "run")
        arguments = ["--task", TASK, "--sim_device", "cpu", "--resume", "--max_iterations", str(2 + iterations)]
        arguments += [] if robots is None else ["--num_envs", str(robots)]
        outcome = run(train.main, [*arguments, *SMALL, *changes])
        for run_folder in run_folders():
            for iteration in checkpoints(run_folder):
                saved = torch.load(run_folder / f"model_{iteration}.pt", weights_only=True)
                for network in ("actor_state_dict", "critic_state_dict"):
                    assert all(torch.isfinite(tensor).all() for tensor in saved[network].values()), outcome.err
        assert sorted(path.name for path in folder.iterdir()) == ["logs"]


@given(first=st.integers(1, 3), second=st.integers(1, 3), robots=NUMBER, seed=st.integers(0, 5), data=st.data())
def test_two_parts_are_a_whole(first, second, robots, seed, data, run, in_new_folder):
    task = data.draw(st.sampled_from([TASK, "anymal_c_blind"]))
    loop = data.draw(st.sampled_from(["captured", "stock"]))
    base = ["--task", task, "--sim_device", "cpu", "--num_envs", str(robots), "--seed", str(seed), "--runner", loop, *SMALL]
    base += ["env.episode_length_s=0.2", "domain_rand.push_interval_s=0.05", "train.algorithm.num_mini_batches=2"]
    base += ["train.policy.actor_hidden_dims=[8]", "train.policy.critic_hidden_dims=[8]"]
    base += ["terrain.num_rows=2", "terrain.num_cols=10", "terrain.border_size=3"] if task != TASK else []
    with in_new_folder():
        assert run(train.main, [*base, "--experiment_name", "whole", "--max_iterations", str(first + second)]).code == 0
        assert run(train.main, [*base, "--experiment_name", "parts", "--max_iterations", str(first)]).code == 0
        again = ["--task", task, "--sim_device", "cpu", "--experiment_name", "parts", "--resume"]
        assert run(train.main, [*again, "--max_iterations", str(first + second)]).code == 0
        last = f"model_{first + second - 1}.pt"
        whole, parts = (next(Path("logs").glob(f"{name}/*/{last}")) for name in ("whole", "parts"))
        states = [torch.load(path, weights_only=True) for path in (whole, parts)]
        for network in ("actor_state_dict", "critic_state_dict"):
            for name, tensor in states[0][network].items():
                assert torch.equal(tensor, states[1][network][name]), f"{network} {name}"


@given(overrides=OVERRIDES, terrain=st.sampled_from([None, "stairs_up", "gap", "flat", "waves"]))
def test_playing_with_changes(overrides, terrain, trained, run, in_new_folder):
    heavy = {
        "env.num_envs",
        "control.decimation",
        "sim.iterations",
        "sim.ls_iterations",
        "domain_rand.friction_buckets",
        "sim.dt",
    }
    heavy |= {"train.runner.experiment_name"}
    changes = [f"{path}={text_of(value)}" for path, value in overrides if path not in heavy]
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "logs" / TASK / "run")
        where = [] if terrain is None else ["--terrain", terrain]
        run(play.main, ["--task", TASK, "--sim_device", "cpu", "--no-video", "--num_envs", "1", *where, *SMALL, *changes])
        assert run_config(folder / "logs" / TASK / "run").task == TASK
