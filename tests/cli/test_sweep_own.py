"""The task's own settings in a sweep: the first trial has them, and what is found stands beside them."""

from pathlib import Path

import pytest
import yaml
from helpers import call

from legged.cli.sweep import run as sweep
from legged.sweeping.plan import plan_sweep
from legged.sweeping.trials import Trials, ranking

pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
pytestmark = pytest.mark.usefixtures("workplace")

FILE = {
    "task": "half_cheetah",
    "trials": 3,
    "objective": {"figure": "return"},
    "overrides": {
        "env": {"num_envs": 4, "episode_length_s": 0.5},
        "sim": {"physics": "mujoco", "threads": 1},
        "train.runner": {"max_iterations": 1, "num_steps_per_env": 4, "evaluate_interval": 1, "evaluate_envs": 2},
        "train.policy": {"actor_hidden_dims": [8], "critic_hidden_dims": [8], "activation": "elu"},
    },
}
FLAGS = ["mine.yaml", "--sim-device", "cpu"]


def plan_of(parameters):
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump({**FILE, "parameters": parameters}))
    return plan_sweep(path, on_cpu=True)


AMONG = {
    "train.algorithm.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "train.algorithm.num_learning_epochs": {"low": 1, "high": 9},
    "train.policy.activation": {"choices": ["tanh", "elu"]},
    "train.policy.actor_hidden_dims": {"choices": [[16], [8]]},
}


@pytest.mark.slow
def test_of_processes_that_begin_at_once_one_makes_the_trial_of_the_own_settings():
    plan = plan_of(AMONG)
    assert plan.own["train.policy.actor_hidden_dims"] == [8]
    assert plan.own["train.algorithm.learning_rate"] == plan.cfg.train.algorithm.learning_rate
    trials, beside = Trials(plan), Trials(plan, worker=1)
    first, second = trials.next(), beside.next()
    assert trials.plan.settings(first.params) == plan.own
    assert beside.plan.settings(second.params) != plan.own


@pytest.mark.slow
def test_what_is_found_stands_beside_the_own_settings(capsys):
    plan = plan_of(AMONG)
    assert call(sweep.main, FLAGS) == 0
    out = capsys.readouterr().out
    assert "the sweep excludes" not in out
    all_trials = Trials(plan).all
    assert [plan.settings(trial.params) == plan.own for trial in all_trials] == [True, False, False]
    rank = ranking(plan, all_trials).index(all_trials[0]) + 1
    assert f"; the task's own settings: trial 0, {all_trials[0].value:.4g}, rank {rank} of 3" in out
    assert "Trial 0 has the task's own settings." in (plan.folder / "table.md").read_text()


@pytest.mark.slow
def test_own_settings_that_are_not_among_those_tried_are_told(capsys):
    plan = plan_of(
        {
            "train.algorithm.gamma": {"low": 0.5, "high": 0.6},
            "train.algorithm.lam": {"low": 0.9, "high": 1.0},
            "train.policy.activation": {"choices": ["relu", "tanh"]},
        }
    )
    assert call(sweep.main, FLAGS) == 0
    gamma = plan.own["train.algorithm.gamma"]
    said = f"because the sweep excludes these values: train.algorithm.gamma {gamma}, train.policy.activation 'elu'\n"
    assert said in capsys.readouterr().out
    assert all(plan.settings(trial.params)["train.algorithm.gamma"] <= 0.6 for trial in Trials(plan).all)
    assert "own settings" not in (plan.folder / "table.md").read_text()
