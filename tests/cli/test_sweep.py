"""Sweeps: what their files ask for, what becomes of trials, and what is left when processes are killed."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from importlib import util
from pathlib import Path

import pytest
import yaml
from helpers import HANG_S, call, wait_for

import legged
from legged.cli.sweep import PRUNED, NoValue, value_of
from legged.cli.sweep import report as reporting
from legged.cli.sweep import run as sweep
from legged.errors import ConfigError
from legged.evaluation.reports.record import read_note
from legged.learning.evaluations import Evaluated
from legged.learning.run_folder import checkpoints, run_config
from legged.learning.timing import read_timing
from legged.process.paths import data_folder
from legged.registry import task_names
from legged.sweeping import plan as planning
from legged.sweeping import trials as study
from legged.sweeping.plan import plan_sweep
from legged.sweeping.trials import Trials, is_dead, me, ranking

optuna = pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
pytestmark = pytest.mark.usefixtures("workplace")

REPOSITORY = Path(legged.__file__).parents[1]
FILE = {
    "task": "half_cheetah",
    "trials": 3,
    "startup_trials": 2,
    "objective": {"figure": "return", "take": "last"},
    "overrides": {
        "env": {"num_envs": 4, "episode_length_s": 0.5},
        "sim": {"physics": "mujoco", "threads": 1},
        "train.runner": {"max_iterations": 2, "num_steps_per_env": 4, "evaluate_interval": 1, "evaluate_envs": 2},
        "train.policy.actor_hidden_dims": [8],
        "train.policy.critic_hidden_dims": [8],
    },
    "parameters": {
        "train.algorithm.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
        "train.algorithm.num_learning_epochs": {"low": 1, "high": 3},
        "train.policy.activation": {"choices": ["elu", "tanh"]},
    },
}
FLAGS = ["mine.yaml", "--sim-device", "cpu"]


def written(**changes) -> Path:
    """The file of a small sweep, some keys of it changed."""
    path = Path("mine.yaml")
    path.write_text(yaml.safe_dump({**FILE, **changes}))
    return path


def plan_of(**changes):
    path = written(**changes)
    return plan_sweep(path, on_cpu=True)


def states(trials: Trials) -> list[str]:
    return [trial.state.name for trial in trials.all]


# ---- what a file asks for --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tasks": "x"}, "mine.yaml: tasks: unknown key 'tasks'; did you mean 'task'?"),
        ({"task": "half_cheeta"}, "mine.yaml: task: there is no task 'half_cheeta'; did you mean 'half_cheetah'?"),
        ({"task": "half_cheeta.yaml"}, "mine.yaml: task: there is no file 'half_cheeta.yaml'"),
        ({"trials": 0}, "mine.yaml: trials: must be at least 1, got 0"),
        ({"parameters": {}}, "mine.yaml: parameters: is empty; name at least one setting"),
        (
            {"parameters": {"train.algorithm.lerning_rate": {"low": 0.1, "high": 0.2}}},
            "mine.yaml: parameters: train.algorithm.lerning_rate: unknown key 'lerning_rate'; did you mean 'learning_rate'?",
        ),
        (
            {"parameters": {"train.algorithm.gamma": {"low": 0.9, "high": 1.5}}},
            "mine.yaml: parameters: train.algorithm.gamma: must be at most 1, got 1.5",
        ),
        (
            {"parameters": {"train.policy.activation": {"choices": ["elu", "tahn"]}}},
            "mine.yaml: parameters: train.policy.activation: unknown value 'tahn'; did you mean 'tanh'?",
        ),
        (
            {"parameters": {"rewards.scales.forwards": {"low": 1, "high": 2}}},
            "mine.yaml: parameters: rewards.scales.forwards",
        ),
        ({"parameters": {"train.algorithm.gamma": {"low": 0.9}}}, "expected low and high of a range, or choices"),
        ({"parameters": {"train.algorithm.gamma": {"low": 0.99, "high": 0.9}}}, "low must be below high, got 0.99 and 0.9"),
        (
            {"parameters": {"train.algorithm.entropy_coef": {"low": 0, "high": 1, "log": True}}},
            "with log, low must be above 0, got 0",
        ),
        (
            {"parameters": {"train.algorithm.num_learning_epochs": {"low": 1.5, "high": 3}}},
            "expected whole numbers for low and high, got 1.5 and 3",
        ),
        ({"parameters": {"env.seed": {"low": 1, "high": 3}}}, "parameters: env.seed: leave it out; the sweep sets it"),
        ({"overrides": {"env.num_env": 3}}, "mine.yaml: overrides: env.num_env: unknown key 'num_env'"),
        ({"objective": {"figure": "reward"}}, "objective.figure: evaluations of 'half_cheetah' do not measure 'reward'"),
        ({"objective": {"take": "time"}}, "objective.target: is missing; give the value of return"),
        ({"storage": "somewhere"}, "storage: 'somewhere' is no storage; expected sqlite:///<file>"),
    ],
)
def test_a_wrong_file_is_one_line_before_anything_is_trained(changes, words, monkeypatch, capsys):
    monkeypatch.setattr("legged.cli.sweep.Worker", lambda *_: pytest.fail("trained"))
    written(**changes)
    assert call(sweep.main, FLAGS) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.splitlines()) == 1


def test_a_sweep_that_is_not_there_and_a_package_that_is_not_installed(monkeypatch, capsys):
    assert call(sweep.main, ["anymal_c_flt"]) == 2
    assert "there is no file 'anymal_c_flt'; did you mean 'anymal_c_flat'? (sweeps: " in capsys.readouterr().err
    written()
    found = util.find_spec
    monkeypatch.setattr(planning, "find_spec", lambda name: None if name == "optuna" else found(name))
    assert call(sweep.main, FLAGS) == 2
    assert capsys.readouterr().err == "error: sweep: the package optuna is not installed; run `pip install optuna`\n"


def test_values_are_of_the_setting_s_kind_and_within_the_range():
    rate, epochs, activation = plan_of().parameters
    assert rate.value(0.00123456) == 0.001235
    assert rate.value(0.01 + 1e-9) == 0.01
    assert epochs.distribution == optuna.distributions.IntDistribution(1, 3)
    assert activation.value('"tanh"') == "tanh"
    (dims,) = plan_of(parameters={"train.policy.actor_hidden_dims": {"choices": [[8], [8, 4]]}}).parameters
    assert dims.value("[8, 4]") == [8, 4]


@pytest.mark.slow
def test_the_sweeps_of_this_package_are_right_and_are_no_tasks():
    files = sorted((data_folder("cfg") / "sweeps").glob("*.yaml"))
    assert {"anymal_c_flat", "half_cheetah_cpu"} <= {path.stem for path in files}
    assert "half_cheetah_cpu" not in task_names()
    for path in files:
        for on_cpu in (True, False):
            plan = plan_sweep(path, on_cpu)
            assert plan.name not in task_names()
            assert plan.cfg.train.runner.max_iterations >= 3 * plan.cfg.train.runner.evaluate_interval


# ---- whose trials are whose ------------------------------------------------------------------------------------------


def test_a_process_is_dead_when_it_has_gone_or_has_been_silent_elsewhere():
    now = time.time()
    assert not is_dead(me(), now - 1e6), "this one is there, whatever it says"
    ended = subprocess.Popen([sys.executable, "-c", ""])
    machine, _, began = me().rsplit(" ", 2)
    ended.wait()
    assert is_dead(f"{machine} {ended.pid} 12345", now)
    assert is_dead(f"{machine} {os.getpid()} {began}0", now), "another process that has got its number"
    assert not is_dead(f"elsewhere {os.getpid()} {began}", now - 60.0)
    assert is_dead(f"elsewhere {os.getpid()} {began}", now - 600.0)
    assert not is_dead(None, now), "it has just been begun"


@pytest.mark.slow
def test_no_more_trials_are_begun_than_are_wanted_whoever_asks():
    first, second = Trials(plan_of()), Trials(plan_of(), worker=1)
    taken = [first.next(), second.next(), first.next()]
    assert [trial.number for trial in taken] == [0, 1, 2]
    drawn = [first.plan.settings(trial.params) for trial in taken]
    assert len({json.dumps(values) for values in drawn}) == 3
    assert first.next() is None
    assert second.next() is None
    first.study.tell(1, 1.0)
    assert first.next() is None
    assert states(second) == ["RUNNING", "COMPLETE", "RUNNING"]
    assert len(second.finished) == 1


@pytest.mark.slow
def test_a_trial_of_a_dead_process_is_tried_again_once_with_its_settings():
    trials, others = Trials(plan_of()), Trials(plan_of())
    trial = trials.next()
    drawn = trials.plan.settings(trial.params)
    assert trials.take_back() == []
    trial.set_user_attr(study.OWNER, me() + "0")
    assert others.take_back() == [0]
    assert trials.take_back() == []
    assert states(trials) == ["FAIL", "WAITING"]
    again = trials.next()
    assert (again.number, trials.plan.settings(again.params)) == (1, drawn)
    assert trials.finished == []
    for tries in range(2, study.MOST_TRIES + 1):
        assert again.user_attrs[study.TRIES] == tries
        again.set_user_attr(study.OWNER, me() + "0")
        trials.take_back()
        again = trials.next()
    assert states(trials) == [*["FAIL"] * (study.MOST_TRIES - 1), "PRUNED", "RUNNING"]
    assert study.TRIES not in again.user_attrs, "that is another one"


def test_another_sweep_of_the_same_name_is_refused():
    Trials(plan_of())
    Trials(plan_of(trials=99))
    with pytest.raises(ConfigError, match="'sweep_mine' was begun with another task, other seeds"):
        Trials(plan_of(seeds=[2]))


def test_a_journal_is_a_storage_too():
    plan = plan_of(storage="journal:shared/mine.journal")
    trial = Trials(plan).next()
    assert trial.number == 0
    assert states(Trials(plan)) == ["RUNNING"]
    assert not (plan.folder / "sweep.db").exists()


# ---- what a trial is worth -------------------------------------------------------------------------------------------


def history(*values: float) -> list[Evaluated]:
    """What evaluations have found, 10 s and 100 steps apart."""
    return [Evaluated(i, {"return": value}, 10.0 * i, 100 * i) for i, value in enumerate(values, 1)]


@pytest.mark.parametrize(
    ("objective", "value"),
    [
        ({"take": "last"}, 3.0),
        ({"take": "best"}, 7.0),
        ({"take": "time", "target": 5.0}, 20.0),
        ({"take": "steps", "target": 5.0}, 200.0),
    ],
)
def test_the_objective_takes_what_it_says(objective, value):
    plan = plan_of(objective={"figure": "return", **objective})
    assert value_of(plan, history(1.0, 7.0, math.nan, 3.0)) == value
    assert plan.minimize == ("target" in objective)


def test_a_target_that_is_not_reached_gives_no_value():
    plan = plan_of(objective={"figure": "return", "take": "time", "target": 5.0})
    with pytest.raises(NoValue, match="did not reach 5; the last was 3"):
        value_of(plan, history(1.0, 3.0))
    with pytest.raises(NoValue, match="return is not finite"):
        value_of(plan, history(math.nan))


# ---- sweeps ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_trials_are_ordinary_runs_and_the_report_names_the_best(capsys):
    written(seeds=[1, 2])
    assert call(sweep.main, [*FLAGS, "--trials", "4"]) == 0
    out = capsys.readouterr().out
    assert "sweep_mine: 4 trials of half_cheetah for the last return; 1 at once" in out
    plan = plan_of(seeds=[1, 2])
    trials = Trials(plan)
    assert states(trials) == ["COMPLETE"] * 4
    best = ranking(plan, trials.all)[0]
    assert best.value == max(trial.value for trial in trials.all)
    for trial in trials.all:
        wanted = plan.settings(trial.params)
        for run, seed in zip(trial.user_attrs[study.RUNS], (1, 2), strict=True):
            cfg = run_config(Path(run))
            assert cfg.env.seed == seed
            assert cfg.train.algorithm.learning_rate == wanted["train.algorithm.learning_rate"]
            assert cfg.train.algorithm.num_learning_epochs == wanted["train.algorithm.num_learning_epochs"]
            assert cfg.train.policy.activation == wanted["train.policy.activation"]
            assert list(checkpoints(Path(run))) == [0, 1]
            assert read_timing(Path(run)).finished
    # The second seed's reports come after the first one's, and are means over both.
    steps = best.intermediate_values
    assert list(steps) == [1, 2, 3, 4]
    assert steps[4] == pytest.approx(best.value)

    table = (plan.folder / "table.md").read_text()
    assert f"| 1 | {best.number} | {best.value:.4g} |" in table
    assert all(f"`{path}=" in table for path in plan.given.overrides)
    assert plan.given.overrides
    found = yaml.safe_load((plan.folder / "best.yaml").read_text())
    assert found["train"]["policy"]["activation"] == plan.settings(best.params)["train.policy.activation"]
    for name in ("history", "parallel"):
        assert (plan.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert call(reporting.main, FLAGS) == 0
    assert f"best: trial {best.number}, last return: {best.value:.4g}" in capsys.readouterr().out


@pytest.mark.slow
def test_a_trial_that_falls_behind_is_ended_and_keeps_its_run(monkeypatch):
    written(trials=1)
    monkeypatch.setattr("optuna.Trial.should_prune", lambda _: True)
    assert call(sweep.main, FLAGS) == 0
    (trial,) = Trials(plan_of(trials=1)).all
    assert trial.state.name == "PRUNED"
    assert trial.user_attrs[study.WHY] == f"{PRUNED} (after 1 iterations)"
    (run,) = trial.user_attrs[study.RUNS]
    assert list(checkpoints(Path(run))) == [0]
    assert not read_timing(Path(run)).finished
    drawn = plan_of(trials=1).settings(trial.params)
    words = ", ".join(f"{path.split('.', 1)[1]} {json.dumps(value)}" for path, value in drawn.items())
    assert read_note(Path(run)) == f"trial 0 of sweep_mine: {words}; {PRUNED} (after 1 iterations)"


@pytest.mark.slow
def test_settings_that_do_not_fit_each_other_have_no_value_and_end_nothing_else():
    """More mini-batches than samples, 16: each choice is right with the samples of another configuration."""
    parameters = {
        "train.algorithm.num_mini_batches": {"choices": [1, 16]},
        "train.runner.num_steps_per_env": {"low": 2, "high": 4},
    }
    written(parameters=parameters, trials=6, startup_trials=6)
    assert call(sweep.main, FLAGS) == 0
    trials = Trials(plan_of(parameters=parameters, trials=6, startup_trials=6)).all
    wrong = [trial for trial in trials if trial.state.name == "PRUNED" and not trial.intermediate_values]
    assert wrong
    for trial in wrong:
        assert "train.algorithm.num_mini_batches: must be at most the" in trial.user_attrs[study.WHY]
    assert sum(trial.state.name == "COMPLETE" for trial in trials) >= 1


@pytest.mark.slow
def test_a_killed_sweep_goes_on_and_loses_nothing():
    """Killed in its second trial at the latest: what was found stays, what was begun is made again with its settings."""
    changes = {"pruner": "none", "trials": 4}
    written(**changes)
    command = [sys.executable, "-m", "legged", "sweep", "run", *FLAGS]
    with open("out.txt", "w") as out:
        process = subprocess.Popen(
            command, stdout=out, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}
        )
        second = Path("logs/sweep_mine/output/trial001.txt")
        wait_for(second.is_file, process)
        process.kill()
        process.wait()
    plan = plan_of(**changes)
    before = Trials(plan).all
    assert before[0].state.name == "COMPLETE"
    assert call(sweep.main, FLAGS) == 0
    after = Trials(plan).all
    assert [trial.state.name for trial in after].count("COMPLETE") == 4
    assert after[0].value == before[0].value
    assert after[0].user_attrs[study.RUNS] == before[0].user_attrs[study.RUNS]
    if before[1].state.name == "RUNNING" and before[1].params:
        assert after[1].state.name == "FAIL"
        assert [trial.params for trial in after if trial.state.name == "COMPLETE"].count(before[1].params) == 1
    # Nothing random is drawn again that was drawn before.
    drawn = [json.dumps(trial.params, sort_keys=True) for trial in after if trial.state.name == "COMPLETE"]
    assert len(set(drawn)) == 4


@pytest.mark.slow
def test_processes_share_a_sweep(capsys):
    written(trials=4, pruner="none")
    assert call(sweep.main, [*FLAGS, "--jobs", "2"]) == 0
    trials = Trials(plan_of(trials=4, pruner="none")).all
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 4
    owners = {trial.user_attrs[study.OWNER] for trial in trials}
    assert {path.name for path in Path("logs/sweep_mine/output").glob("worker*.txt")} == {"worker0.txt", "worker1.txt"}
    assert str(os.getpid()) not in {owner.split()[1] for owner in owners}
    assert [f"[{i} of 4]" in out for out in [capsys.readouterr().out] for i in range(1, 5)] == [True] * 4


@pytest.mark.slow
def test_a_signal_ends_the_trial_with_a_checkpoint_and_it_is_tried_again():
    overrides = {**FILE["overrides"], "train.runner": {**FILE["overrides"]["train.runner"], "max_iterations": 100_000}}
    written(overrides=overrides)
    with open("out.txt", "w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "legged", "sweep", "run", *FLAGS],
            stdout=out,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        )
        output = Path("logs/sweep_mine/output/trial000.txt")
        wait_for(lambda: output.is_file() and "\nit " in output.read_text(), process)
        process.terminate()
        assert process.wait(timeout=HANG_S) == 128 + signal.SIGTERM
    assert "stopped; it will be tried again  [0 of 3]" in Path("out.txt").read_text()
    trials = Trials(plan_of(overrides=overrides))
    assert states(trials) == ["FAIL", "WAITING"]
    (run,) = trials.all[0].user_attrs[study.RUNS]
    assert max(checkpoints(Path(run))) >= 0
    assert trials.next().number == 1
