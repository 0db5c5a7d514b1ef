"""What a policy is worth while it is trained: the figures of `evaluate`, by a task that leaves the training's alone."""

import math

import pytest
import torch
from helpers import ENGINE, small_config, small_task
from torch import nn

from legged.config import override
from legged.envs.actions import ordinary_tensors
from legged.errors import ConfigError
from legged.evaluation.during_training import TrainingEvaluation, few_commands, thinned
from legged.evaluation.velocity_tracking import measure_tracking
from legged.graph.step_graph import StepGraph
from legged.learning.run_state import generators
from legged.policies.actor import Actor
from legged.registry import make_task, task_config

NETWORK = [("train.policy.actor_hidden_dims", [8]), ("train.policy.critic_hidden_dims", [8])]
BRIEF = [*NETWORK, ("train.runner.evaluate_envs", 8), ("train.runner.evaluate_s", 0.3)]


def actor_of(task, gain: float) -> nn.Module:
    """A network of the task with made-up weights."""
    network = Actor(task, "cpu").network
    random = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(gain * torch.randn(parameter.shape, generator=random))
    return network


def test_few_robots_get_every_second_command_and_the_ends_stay():
    assert thinned([-1.0, -0.5, 0.0, 0.5, 1.0]) == [-1.0, 0.0, 1.0]
    assert thinned([-1.0, 0.0, 0.5, 1.0]) == [-1.0, 1.0]
    assert thinned([-1.0, 1.0]) == [-1.0]
    grids = {n: few_commands(small_config(("train.runner.evaluate_envs", n))) for n in (300, 125, 40, 8, 1)}
    assert {n: (grid.num_cells, grid.robots) for n, grid in grids.items()} == {
        300: (125, 2),
        125: (125, 1),
        40: (27, 1),
        8: (8, 1),
        1: (1, 1),
    }
    assert grids[40].vx == grids[40].yaw == [-1.0, 0.0, 1.0]
    assert (grids[1].hold_s, grids[1].settle_s) == (3.0, 1.0)
    assert few_commands(small_config(("train.runner.evaluate_s", 0.3))).settle_s == pytest.approx(0.1)


@pytest.mark.slow
def test_figures_are_those_that_evaluate_finds_on_the_same_grid():
    """The same robots by the other way of measuring: rewards and errors of a policy under which nobody falls."""
    training = small_task(*BRIEF, ("env.seed", 5), num_envs=2)
    evaluation = TrainingEvaluation(training)
    network = actor_of(training, 1e-3)
    found = evaluation.measure(network)
    assert list(found) == list(evaluation.figures) == ["lin_vel_rmse", "ang_vel_rmse", "falls", "return"]

    task = evaluation.task
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        rewards = []
        step = task.step
        task.step = lambda actions: (lambda out: (rewards.append(out[1]), out)[1])(step(actions))
        wanted = measure_tracking(task, network, few_commands(training.cfg))
    assert wanted["falls"] == found["falls"] == 0.0
    assert found["lin_vel_rmse"] == pytest.approx(wanted["rmse_lin"]["mean"], rel=1e-5)
    assert found["ang_vel_rmse"] == pytest.approx(wanted["rmse_ang"]["mean"], rel=1e-5)
    assert len(rewards) == round(0.3 / task.dt) == 15
    assert found["return"] == pytest.approx(float(torch.stack(rewards).sum(dim=0).mean()) / task.dt, rel=1e-5)


@pytest.mark.slow
def test_a_step_of_it_fits_a_graph():
    """The guard finds nothing in it that no CUDA graph could hold."""
    evaluation = TrainingEvaluation(small_task(*BRIEF, num_envs=2))
    with ordinary_tensors():
        StepGraph(evaluation._step, torch.device("cpu"), enabled=True)


@pytest.mark.slow
def test_who_has_fallen_counts_as_standing_still():
    """Terminated in the first step: from then on the error is the whole command, cell by cell."""
    training = small_task(*BRIEF, ("terminations.min_base_height", 5.0), num_envs=2)
    evaluation = TrainingEvaluation(training)
    found = evaluation.measure(actor_of(training, 1e-3))
    cells = few_commands(training.cfg).cells
    assert found["falls"] == 1.0
    assert found["lin_vel_rmse"] == pytest.approx(sum(math.hypot(*cell[:2]) for cell in cells) / len(cells), rel=1e-6)
    assert found["ang_vel_rmse"] == pytest.approx(abs(cells[:, 2]).mean(), rel=1e-6)


@pytest.mark.slow
def test_the_same_policy_is_worth_the_same_again_and_nothing_random_is_drawn():
    training = small_task(*BRIEF, num_envs=2)
    before = generators()
    evaluation = TrainingEvaluation(training)
    network, other = actor_of(training, 1e-3), actor_of(training, 0.1)
    weights = [parameter.clone() for parameter in network.parameters()]
    first = evaluation.measure(network)
    assert evaluation.measure(other) != first
    assert evaluation.measure(network) == first
    assert all(torch.equal(a, b) for a, b in zip(weights, network.parameters(), strict=True))
    after = generators()
    assert torch.equal(before["torch"], after["torch"])
    assert torch.equal(before["numpy"][1], after["numpy"][1])
    assert before["python"] == after["python"]


@pytest.mark.slow
def test_nothing_disturbs_the_robots_but_their_ground_and_their_commands():
    cfg = task_config("anymal_c", [("env.num_envs", 2), ("sim.physics", "mujoco"), ("sim.threads", 1), *BRIEF], on_cpu=True)
    cfg = override(cfg, [("domain_rand.ranges.friction", [0.5, 1.0])])
    task = TrainingEvaluation(make_task(cfg)).task
    assert not task.cfg.observations.add_noise
    assert not task.cfg.domain_rand.push_robots
    assert task.randomization.fields == {}
    assert task.terrain is not None
    assert task.env_origins.unique(dim=0).shape == (1, 3), "all robots start on one tile, as in `evaluate`"


def test_other_tasks_are_judged_by_the_return_of_whole_episodes_and_their_metrics():
    given = [("env.num_envs", 2), ("env.episode_length_s", 0.5), ("train.runner.evaluate_envs", 3), ("sim.threads", 1)]
    training = make_task(task_config("half_cheetah", [*given, *NETWORK], on_cpu=True))
    evaluation = TrainingEvaluation(training)
    assert evaluation.task.num_envs == 3
    network = actor_of(training, 0.1)
    found = evaluation.measure(network)
    assert list(found) == ["return", "falls", "episode_length", "x_velocity"]
    assert found["episode_length"] == 10.0
    assert found["falls"] == 0.0
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.cfg.env.seed)
        task = evaluation.task
        observations, total = task.reset(), torch.zeros(3)
        for _ in range(10):
            observations, rewards, _, _ = task.step(network(observations))
            total += rewards
        speed = task.metrics.flush()["Metrics/x_velocity"]
    assert found["return"] == pytest.approx(float(total.mean()), rel=1e-5)
    assert found["x_velocity"] == pytest.approx(float(speed), rel=1e-5)


@pytest.mark.slow
def test_a_recurrent_policy_begins_each_evaluation_without_memory():
    recurrent = {"policy.rnn_type": "gru", "policy.rnn_hidden_dim": 4, "algorithm.symmetry": False}
    training = small_task(*BRIEF, *((f"train.{name}", value) for name, value in recurrent.items()))
    evaluation = TrainingEvaluation(training)
    network = actor_of(training, 0.1)
    network(training.get_observations())
    memory = network.get_hidden_state().clone()
    assert evaluation.measure(network) == evaluation.measure(network)
    assert torch.equal(network.get_hidden_state(), memory), "the training's own memory is another"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            [("train.runner.stop_at", {"velocity": 0.1})],
            "stop_at.velocity: evaluations of 'anymal_c_flat' report no 'velocity'",
        ),
        ([("train.runner.best_by", "lin_rmse")], "best_by: .* report no 'lin_rmse'; did you mean 'lin_vel_rmse'"),
        ([("train.runner.stop_at", {"falls": 0.1})], "stop_at: needs evaluations .* set train.runner.evaluate_interval"),
    ],
)
def test_what_evaluations_do_not_find_is_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        small_config(*changes)


@pytest.mark.parametrize("name", ["anymal_c_flat", "half_cheetah"])
def test_evaluations_that_are_over_before_the_first_step_are_refused(name):
    """The message is about the setting that was given; for tasks without commands it was about env.episode_length_s."""
    changes = [("train.runner.evaluate_interval", 1), ("train.runner.evaluate_s", 0.005)]
    with pytest.raises(ConfigError, match=r"train.runner.evaluate_s: must be at least a control step of .*, got 0.005"):
        TrainingEvaluation(make_task(task_config(name, [("env.num_envs", 8), *ENGINE, *changes], on_cpu=True)))
