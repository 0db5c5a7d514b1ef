"""Critic warm-up: for some iterations the value function learns alone, then both learn as if nothing had been before."""

import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, tiny_run
from learners import fill, learner
from test_resume import content, same

from legged.cli.train import train
from legged.envs import BaseTask
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import read_checkpoint
from legged.learning.critic_warmup import CriticWarmup
from legged.learning.ppo import DevicePPO
from legged.learning.run_folder import run_config
from legged.registry import make_task

pytestmark = pytest.mark.usefixtures("workplace")

KINDS = {"stock": CriticWarmup, "captured": DevicePPO}


def weights(alg) -> dict[str, dict[str, torch.Tensor]]:
    """All of actor and critic, with standard deviation and normaliser."""
    return {name: {k: t.clone() for k, t in getattr(alg, name).state_dict().items()} for name in ("actor", "critic")}


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_the_policy_is_kept_bit_by_bit_and_the_value_function_learns(kind, normalized):
    alg = learner(KINDS[kind], normalized)
    alg.warmup_left = 2
    rate = alg.learning_rate
    for seed, learns in enumerate([False, False, True]):
        before = weights(alg)
        fill(alg, seed)
        losses = alg.update()
        now = weights(alg)
        assert same(now["actor"], before["actor"]) is not learns
        assert not any(torch.equal(now["critic"][k], t) for k, t in before["critic"].items() if "weight" in k)
        assert losses["value"] > 0.0
        assert (alg.learning_rate == rate) is not learns, "the rate follows the policy's divergence"


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_step_of_the_policy_afterwards_is_a_first_step(kind):
    """Adam's first step has the size of the learning rate, by each weight; gradients of 0 before it would make it larger."""
    alg = learner(KINDS[kind], schedule="fixed", num_mini_batches=1, num_learning_epochs=1, learning_rate=1e-3)
    alg.warmup_left = 5
    for seed in range(5):
        fill(alg, seed)
        alg.update()
    before = weights(alg)["actor"]
    fill(alg, 5)
    alg.update()
    moved = torch.cat([(t - before[k]).abs().flatten() for k, t in weights(alg)["actor"].items()])
    assert 0.9e-3 < float(moved.max()) <= 1.001e-3


def test_both_loops_learn_the_same_value_function(monkeypatch):
    algs = [learner(kind, num_mini_batches=1) for kind in KINDS.values()]
    for alg in algs:
        alg.warmup_left = 1
        fill(alg, 0)
        alg.update()
    for name, tensor in algs[0].critic.state_dict().items():
        torch.testing.assert_close(algs[1].critic.state_dict()[name], tensor, rtol=1e-3, atol=2e-5, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["stock", "captured"])
def test_training_warms_up_and_is_resumed_in_the_middle_bit_by_bit(loop):
    arguments = ["--runner", loop, "train.algorithm.critic_warmup_iterations=3", "train.runner.save_interval=1"]
    four = tiny_run(*arguments, iterations=5)
    policies = [content(four, iteration)["actor_state_dict"] for iteration in range(5)]
    assert same(policies[0], policies[2])
    assert not same(policies[2], policies[3])
    critics = [content(four, iteration)["critic_state_dict"] for iteration in range(5)]
    assert not same(critics[0], critics[1])
    two = tiny_run(*arguments, iterations=2)
    rest = tiny_run("--resume", "--load_run", str(two), iterations=5)
    for part in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict"):
        assert same(content(rest, 4)[part], content(four, 4)[part]), part


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["stock", "captured"])
def test_a_resumed_training_may_end_its_warmup(loop):
    run = tiny_run("--runner", loop, "train.algorithm.critic_warmup_iterations=9", iterations=1)
    rest = tiny_run("--resume", "--load_run", str(run), "train.algorithm.critic_warmup_iterations=0", iterations=2)
    assert not same(content(rest, 1)["actor_state_dict"], content(run, 0)["actor_state_dict"])


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["stock", "captured"])
def test_a_transfer_with_warmup_takes_the_policy_alone(loop, capsys):
    """Of a file with other hidden layers in its critic, or with none at all, with the standard deviation of a new policy."""
    source = tiny_run("train.policy.critic_hidden_dims=[6]", "train.algorithm.max_grad_norm=0.5")
    saved = read_checkpoint(source / "model_1.pt")
    for part in ("critic_state_dict", "optimizer_state_dict"):
        del saved[part]
    torch.save(saved, source / "model_2.pt")
    taken = saved["actor_state_dict"]
    warmup = ["--runner", loop, "train.algorithm.critic_warmup_iterations=1", "train.policy.init_noise_std=0.1"]
    for checkpoint in ("1", "2"):
        flags = ["--transfer", str(source), "--checkpoint", checkpoint, *warmup]
        begun = content(tiny_run(*flags, iterations=1), 0)["actor_state_dict"]
        std = begun.pop("distribution.std_param")
        assert torch.equal(std, torch.full_like(std, 0.1))
        assert same(begun, {name: tensor for name, tensor in taken.items() if name != "distribution.std_param"})
    capsys.readouterr()
    refused = ["--task", TASK, "--transfer", str(source), "--checkpoint", "2", "--sim_device", "cpu"]
    assert call(train.main, [*refused, *TINY_TRAINING]) == 2
    assert "train.algorithm.critic_warmup_iterations=50 trains a new value function" in capsys.readouterr().err


@pytest.mark.slow
def test_trial_steps_of_a_capture_leave_no_moments(monkeypatch):
    """The value function's were saved in the middle of a warm-up; those of the policy come to be while graphs are tried."""
    half = tiny_run("train.algorithm.critic_warmup_iterations=2", "train.runner.loop=stock", iterations=1)
    runner = CapturedRunner(make_task(run_config(half)), None, "cpu")
    assert runner.resume(str(half / "model_0.pt")) == ""
    values = {id(parameter) for parameter in runner.alg.critic.parameters()}
    before = {key: state["exp_avg"].clone() for key, state in runner.alg.optimizer.state.items()}
    assert {id(key) for key in before} == values
    monkeypatch.setattr(BaseTask, "captured", True)  # steps are tried as on a GPU
    runner.alg.train_mode()
    runner._capture(runner._steps(), True)
    tried = [key for key in runner.alg.optimizer.state if id(key) not in values]
    assert tried, "or there is nothing to see here"
    for key, state in runner.alg.optimizer.state.items():
        if id(key) in values:
            assert torch.equal(state["exp_avg"], before[key])
        else:
            assert not any(tensor.any() for tensor in state.values())
