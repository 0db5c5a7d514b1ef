"""Trainings with evaluations: they learn what they would without, keep their best policy, and end at a target."""

import itertools
import json
from pathlib import Path

import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, checkpoints, run_folders, small_config, tiny_run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from legged.cli.evaluate import grid as evaluate_grid
from legged.cli.train import train
from legged.config.learning import RunnerConfig
from legged.evaluation.during_training import TrainingEvaluation
from legged.learning.checkpoint import read_checkpoint
from legged.learning.evaluations import Evaluations
from legged.learning.timing import read_timing

pytestmark = pytest.mark.usefixtures("workplace")

ALWAYS = "train.runner.evaluate_share=1"
BRIEF = ["train.runner.evaluate_envs=8", "train.runner.evaluate_s=0.1", ALWAYS]
EVERY = ["train.runner.evaluate_interval=1", *BRIEF]


class Found:
    """A measurement that finds one value after the other, each in a second."""

    figures = ("lin_vel_rmse", "return")

    def __init__(self, *values: float):
        self.values, self.clock = iter(values), itertools.count()

    def measure(self, policy):
        value = next(self.values)
        return {"lin_vel_rmse": value, "return": -10.0 * value}


def evaluations(*values: float, **runner) -> Evaluations:
    given = [(f"train.runner.{name}", value) for name, value in {"evaluate_interval": 5, **runner}.items()]
    found = Found(*values)
    return Evaluations(small_config(*given), found, lambda: float(next(found.clock)))


def run(evals: Evaluations, values: int) -> list[bool]:
    """Evaluate so many times; whether each was the best."""
    return [evals.evaluate(nn.Identity(), 5 * (i + 1), 0.0, 0) for i in range(values)]


# ---- when, which, and until when -------------------------------------------------------------------------------------


def test_it_is_due_at_every_interval_while_it_takes_less_than_its_share():
    """An evaluation takes 1 s. Of 3 % in all, one and the last need 2 s: there is time for the second after 100 s."""
    evals = evaluations(1.0, 1.0, 1.0)
    assert [evals.due(i, 100, 0.0) for i in (1, 4, 5, 6, 10, 100)] == [False, False, True, False, True, True]
    run(evals, 1)
    assert [evals.due(10, 100, loop_s) for loop_s in (1.0, 99.0, 101.0)] == [False, False, True]
    run(evals, 1)
    assert [evals.due(10, 100, loop_s) for loop_s in (101.0, 132.0, 134.0)] == [False, False, True]
    assert evals.due(100, 100, 1.0), "the last is never left out"
    always = evaluations(1.0, evaluate_share=1.0)
    run(always, 1)
    assert always.due(10, 100, 1.0)


def test_the_best_is_the_lowest_error_or_the_highest_return():
    by_error = evaluations(0.5, 0.6, float("nan"), 0.4, 0.4)
    assert run(by_error, 5) == [True, False, False, True, False]
    assert by_error.best == 0.4
    by_return = evaluations(0.5, 0.6, 0.4, best_by="return")
    assert run(by_return, 3) == [True, False, True]
    assert by_return.best == -4.0


def test_a_target_is_reached_when_all_its_figures_are_at_the_same_time():
    evals = evaluations(0.5, 0.2, 0.1, stop_at={"lin_vel_rmse": 0.2, "return": -1.5})
    run(evals, 2)
    assert not evals.reached
    assert not evals.why_end
    run(evals, 1)
    assert evals.reached
    assert evals.why_end.startswith(
        "the training reached its target after 5 iterations: lin_vel_rmse 0.1 (stop_at 0.2), return -1"
    )


def test_who_listens_may_end_a_training():
    evals = evaluations(0.5, 0.4)
    told = []
    evals.listener = lambda found: told.append(found.figures["lin_vel_rmse"]) or ("enough" if len(told) == 2 else "")
    run(evals, 1)
    assert not evals.why_end
    run(evals, 1)
    assert (evals.why_end, evals.reached, told) == ("enough", False, [0.5, 0.4])


# ---- trainings -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["captured", "stock"])
def test_a_training_learns_the_same_with_evaluations_and_without(loop):
    arguments = [f"train.runner.loop={loop}", "train.runner.save_interval=1"]
    plain = tiny_run(*arguments, iterations=3)
    evaluated = tiny_run(*arguments, *EVERY, iterations=3)
    for iteration in range(3):
        a, b = (read_checkpoint(folder / f"model_{iteration}.pt") for folder in (plain, evaluated))
        for part in ("actor_state_dict", "critic_state_dict"):
            assert all(torch.equal(a[part][name], b[part][name]) for name in a[part])
    states = [torch.load(folder / "state_2.pt", weights_only=True) for folder in (plain, evaluated)]
    assert torch.equal(states[0]["generators"]["torch"], states[1]["generators"]["torch"])
    assert torch.equal(states[0]["task"]["physics"]["qpos"], states[1]["task"]["physics"]["qpos"])
    assert not (plain / "model_best.pt").exists()

    events = EventAccumulator(str(evaluated))
    events.Reload()
    logged = events.Scalars("Evaluation/lin_vel_rmse")
    assert [event.step for event in logged] == [0, 1, 2]
    best = read_checkpoint(evaluated / "model_best.pt")
    lowest = min(logged, key=lambda event: event.value)
    assert best["iter"] == lowest.step
    assert best["infos"]["evaluation"]["lin_vel_rmse"] == pytest.approx(lowest.value)
    weights = read_checkpoint(evaluated / f"model_{lowest.step}.pt")["actor_state_dict"]
    assert all(torch.equal(best["actor_state_dict"][name], weights[name]) for name in weights)
    assert read_timing(evaluated).evaluation_s > 0.0
    assert read_timing(plain).evaluation_s == 0.0


@pytest.mark.slow
def test_a_figure_that_is_no_number_is_left_out_of_the_best_checkpoint(monkeypatch):
    measure = TrainingEvaluation.measure
    monkeypatch.setattr(TrainingEvaluation, "measure", lambda *args: measure(*args) | {"return": float("nan")})
    folder = tiny_run(*EVERY, iterations=1)
    found = read_checkpoint(folder / "model_best.pt")["infos"]["evaluation"]
    assert "lin_vel_rmse" in found
    assert "return" not in found


@pytest.mark.slow
def test_a_training_ends_at_its_target_and_counts_as_finished(capsys):
    arguments = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "9", *TINY_TRAINING]
    assert train.main([*arguments, *BRIEF, "train.runner.evaluate_interval=2", "train.runner.stop_at.falls=0.9"]) == 0
    (folder,) = run_folders()
    assert checkpoints(folder) == [0, 1]
    assert (read_timing(folder).finished, read_timing(folder).iterations) == (True, 2)
    out = capsys.readouterr().out
    assert "reached its target after 2 iterations: falls 0 (stop_at 0.9)" in out
    assert "finished after 2 iterations" in out


@pytest.mark.slow
def test_the_best_policy_can_be_played_and_trained_on(capsys):
    folder = tiny_run(*EVERY, iterations=3)
    best = read_checkpoint(folder / "model_best.pt")
    again = tiny_run("--resume", "--checkpoint", "best", iterations=5)
    assert max(checkpoints(again)) == 4
    flags = [str(folder), "--sim-device", "cpu", "--checkpoint"]
    one = ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1", "--physics", "mujoco"]
    assert call(evaluate_grid.main, [*flags, "best", *one]) == 0
    assert json.loads((folder / "evaluation_mujoco.json").read_text())["checkpoint"] == "model_best.pt"
    plain = tiny_run(iterations=1)
    flags[0] = str(plain)
    assert call(evaluate_grid.main, [*flags, "best"]) == 2
    assert f"{plain.name} has no model_best.pt; a training writes it if train.runner" in capsys.readouterr().err
    assert call(evaluate_grid.main, [*flags, "bset"]) == 2
    assert "'bset' (allowed: an iteration, or best)" in capsys.readouterr().err
    assert best["iter"] in range(3)


@pytest.mark.slow
def test_a_resumed_training_keeps_the_best_of_what_it_goes_on_from(monkeypatch):
    """What has been good is not beaten here: all later figures are made worse."""
    folder = tiny_run(*EVERY, iterations=2)
    best = (folder / "model_best.pt").read_bytes()
    real = Evaluations.evaluate

    def worse(self, policy, *rest):
        measure = self._measurement.measure
        self._measurement.measure = lambda policy: {name: 100.0 + value for name, value in measure(policy).items()}
        try:
            return real(self, policy, *rest)
        finally:
            self._measurement.measure = measure

    monkeypatch.setattr(Evaluations, "evaluate", worse)
    again = tiny_run("--resume", iterations=4)
    assert (again / "model_best.pt").read_bytes() == best
    # A best policy that is younger than the checkpoint is none of this training's past.
    saved = read_checkpoint(folder / "model_best.pt")
    torch.save({**saved, "iter": 7}, folder / "model_best.pt")
    other = tiny_run("--resume", "--load_run", str(folder), iterations=4)
    assert read_checkpoint(other / "model_best.pt")["infos"]["evaluation"]["lin_vel_rmse"] > 100.0


def test_nothing_is_evaluated_unless_it_is_asked_for():
    assert RunnerConfig().evaluate_interval == 0
    assert not Path("logs").exists()
