"""The table of a sweep: what it says of trials that were ended early."""

import json
import shlex
import warnings
from pathlib import Path

import pytest
import torch
import yaml
from helpers import call

from legged.cli.sweep import report as reporting
from legged.cli.sweep import run as sweep
from legged.config import parse_override
from legged.sweeping.plan import plan_sweep
from legged.sweeping.trials import Trials, draw_figures, table

optuna = pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.parametrize(
    ("objective", "reported", "said"),
    [
        ({"figure": "return", "take": "last"}, -820.0, "-820 at 10"),
        ({"figure": "return", "take": "last"}, 820.0, "820 at 10"),
        ({"figure": "return", "take": "time", "target": 5.0}, 820.0, "-820 at 10"),  # there the worker negates returns
        ({"figure": "return", "take": "time", "target": 5.0}, -3.5, "3.5 at 10"),
    ],
)
def test_a_trial_that_was_ended_early_stands_with_the_figure_it_had(objective, reported, said):
    parameters = {"train.algorithm.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}
    given = {"task": "half_cheetah", "trials": 3, "objective": objective, "parameters": parameters}
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump(given))
    plan = plan_sweep(path, on_cpu=True)
    trial = optuna.trial.create_trial(state=optuna.trial.TrialState.PRUNED, intermediate_values={5: 1.0, 10: reported})
    assert f"; {said} |" in table(plan, [trial])


def test_the_command_of_the_best_trial_sets_what_it_was_trained_with():
    """All digits of a choice, texts that look like numbers, and where the task comes from."""
    choices = {
        "rewards.tracking_sigma": [0.25, 0.123456789],
        "train.policy.actor_hidden_dims": [[32, 32], [16]],
        "train.policy.activation": ["elu", "relu"],
        "rewards.only_positive_rewards": [True, False],
    }
    given = {"task": "anymal_c_flat", "parameters": {path: {"choices": values} for path, values in choices.items()}}
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump(given))
    plan = plan_sweep(path, on_cpu=True)
    wanted = {path: values[-1] for path, values in choices.items()}
    drawn = {path: json.dumps(value) for path, value in wanted.items()}
    kinds = {one.path: one.distribution for one in plan.parameters}
    text = table(plan, [optuna.trial.create_trial(params=drawn, distributions=kinds, value=0.5)], "own tasks.py")
    (command,) = [line for line in text.splitlines() if line.startswith("legged train ")]
    program, flags, settings = (shlex.split(command)[at] for at in (slice(2), slice(2, 5), slice(5, None)))
    assert program == ["legged", "train"]
    assert flags == ["--import", "own tasks.py", "anymal_c_flat"]
    assert dict(map(parse_override, settings)) == wanted
    assert "| false | 0.123456789 | relu | [16] |" in text
    assert "train.policy.activation=relu" in command


@pytest.mark.slow
def test_nothing_is_said_to_matter_where_all_trials_are_alike():
    """As when each reaches its target at the first evaluation: optuna warns, and calls all settings alike important."""
    values = {
        "train.algorithm.learning_rate": {"low": 1e-4, "high": 1e-2},
        "train.policy.activation": {"choices": ["elu", "tanh"]},
    }
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump({"task": "half_cheetah", "parameters": values}))
    trials = Trials(plan_sweep(path, on_cpu=True))
    for _ in range(6):
        trial = trials.next()
        trials.study.tell(trial.number, 1920.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert "importance.png" not in {path.name for path in draw_figures(trials)}


def test_a_sweep_that_was_begun_on_a_cpu_does_not_go_on_with_a_gpu_but_is_reported_anywhere(capsys, monkeypatch):
    parameters = {"train.algorithm.learning_rate": {"low": 1e-4, "high": 1e-2}}
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump({"task": "half_cheetah", "trials": 1, "parameters": parameters}))
    trials = Trials(plan_sweep(path, on_cpu=True))
    trials.keep_to("cpu")
    trials.keep_to("cpu")
    monkeypatch.setattr("legged.cli.sweep.pick_device", lambda name: torch.device("cuda"))
    assert call(sweep.main, ["mine.yaml"]) == 2
    said = "error: --sim-device: earlier trials of 'sweep_mine' were trained on cpu and can't be compared with trials on cuda"
    assert capsys.readouterr().err.startswith(said)
    assert call(reporting.main, ["mine.yaml"]) == 0


@pytest.mark.slow
def test_a_task_may_be_a_file_beside_that_of_the_sweep():
    """As it may of `legged train`, whose command in the table names it, as one would from where the sweep was run."""
    runner = {"max_iterations": 2, "num_steps_per_env": 4, "evaluate_interval": 1, "evaluate_envs": 2}
    small = {"env": {"num_envs": 4, "episode_length_s": 0.5}, "sim": {"physics": "mujoco", "threads": 1}}
    task = {"extends": "half_cheetah", **small, "train": {"runner": runner}}
    parameters = {"train.algorithm.gamma": {"low": 0.9, "high": 0.99}}
    Path("mine").mkdir()
    Path("mine/short_cheetah.yaml").write_text(yaml.safe_dump(task))
    given = {"task": "short_cheetah.yaml", "trials": 1, "objective": {"figure": "return"}, "parameters": parameters}
    Path("mine/search.yaml").write_text(yaml.safe_dump(given))
    assert call(sweep.main, ["mine/search.yaml", "--sim-device", "cpu"]) == 0
    text = Path("logs/sweep_search/table.md").read_text()
    assert "`short_cheetah`, for the last return" in text
    assert "legged train mine/short_cheetah.yaml train.algorithm.gamma=0.9" in text


def test_figures_import_matplotlib_as_those_of_other_commands_do(monkeypatch):
    """An unknown MPLBACKEND is a warning there, and else an error of matplotlib."""

    def imported():
        raise InterruptedError

    monkeypatch.setattr("legged.sweeping.trials.import_matplotlib", imported)
    with pytest.raises(InterruptedError):
        draw_figures(None)
