"""The captured training loop computes what rsl-rl's does: rollouts bit by bit, updates to float tolerance."""

from pathlib import Path

import pytest
import torch
from devices import on_both
from helpers import checkpoints, small_task, tiny_run
from learners import MIRROR, SAMPLES, STEPS, fill, learner
from rsl_rl.algorithms import PPO

import legged.learning.captured as captured_module
from legged.evaluation.learning_curves import read_scalars
from legged.graph.step_graph import ForbidHostReads
from legged.learning.captured import CapturedRunner, Clock, copies
from legged.learning.kl_meter import KLMeter
from legged.learning.ppo import DevicePPO
from legged.learning.rollout import Rollout
from legged.learning.run_folder import run_config
from legged.learning.runner import Runner

pytestmark = pytest.mark.usefixtures("workplace")


VARIANTS = {
    "plain": {},
    "normalised": {"normalized": True},
    "log std": {"std_type": "log"},
    "fixed rate": {"schedule": "fixed"},
    "free values": {"use_clipped_value_loss": False, "value_loss_coef": 0.5},
    "advantages per batch": {"normalize_advantage_per_mini_batch": True},
    "symmetry": {"symmetry_cfg": MIRROR, "normalize_advantage_per_mini_batch": True},
    "symmetry, normalised": {"symmetry_cfg": MIRROR, "normalized": True},
    "mixed precision": {"use_mixed_precision": True},
    "mixed precision, symmetry": {"use_mixed_precision": True, "symmetry_cfg": MIRROR},
    "tight clips": {"clip_param": 0.05, "max_grad_norm": 0.1},
}


def exact_or_on_the_cpu(case) -> bool:
    """Whether a learner's numbers can be compared: on a GPU, what is rounded to bfloat16 depends on the order of sums, and
    under tight clips so does on which side of a clip, or of the adaptive rate's threshold, a mini-batch falls.
    """
    device, options = case.values
    return device == "cpu" or not {"use_mixed_precision", "max_grad_norm"} & set(options)


@pytest.mark.slow
@pytest.mark.usefixtures("full_precision")
@pytest.mark.parametrize(("device", "options"), filter(exact_or_on_the_cpu, on_both(VARIANTS)))
def test_an_update_is_that_of_rsl_rl(device, options, monkeypatch):
    """Losses, divergence, learning rate, parameters and moments over three updates on the same data in the same order; with
    mixed precision over two, and losses to a thousandth: MKL adds in an order that depends on the processor (with
    MKL_ENABLE_INSTRUCTIONS=AVX2 all agree to 1e-4), so a number may be rounded to the bfloat16 beside stock's, 0.4 % off.
    """
    rounded = options.get("use_mixed_precision", False)
    stock, ours = learner(PPO, device=device, **options), learner(DevicePPO, device=device, **options)
    meter = KLMeter(stock.actor)
    assert ours.why_stock == ""
    order = torch.Generator().manual_seed(1)
    rates = []
    for seed in range(2 if rounded else 3):
        fill(stock, seed)
        fill(ours, seed)
        permutation = torch.randperm(SAMPLES, generator=order).to(device)
        monkeypatch.setattr(torch, "randperm", lambda *_, p=permutation, **__: p)
        monkeypatch.setattr(ours, "_order", lambda _, p=permutation: p)
        wanted = stock.update()
        monkeypatch.undo()
        monkeypatch.setattr(ours, "_order", lambda _, p=permutation: p)
        found = ours.update()
        kl, asked = found.pop("kl"), meter.flush()
        assert asked is None or kl == pytest.approx(asked, rel=1e-3, abs=1e-6)
        assert (asked is None) == (options.get("schedule") == "fixed")
        assert found == pytest.approx(wanted, rel=1e-3 if rounded else 1e-4, abs=1e-6)
        assert ours.learning_rate == pytest.approx(stock.learning_rate, rel=1e-5)
        rates.append(ours.learning_rate)
    assert len(set(rates)) > 1 or options.get("schedule") == "fixed"
    for model in ("actor", "critic"):
        mine, theirs = (getattr(alg, model).state_dict() for alg in (ours, stock))
        for name, tensor in theirs.items():
            torch.testing.assert_close(mine[name], tensor, rtol=1e-3, atol=2e-5, msg=name)
    moments = [alg.optimizer.state_dict()["state"] for alg in (ours, stock)]
    assert len(moments[0]) == len(moments[1]) == 13
    for key, theirs in moments[1].items():
        torch.testing.assert_close(moments[0][key]["exp_avg"], theirs["exp_avg"], rtol=1e-2, atol=1e-4 if rounded else 1e-5)
        assert float(moments[0][key]["step"]) == float(theirs["step"])


def task_and_runner(kind=Runner, *overrides, num_envs=12):
    task = small_task(*overrides, ("train.runner.num_steps_per_env", STEPS), num_envs=num_envs)
    torch.manual_seed(3)
    return task, kind(task, None, "cpu")


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_a_rollout_is_that_of_rsl_rl(scale):
    """Observations, actions and ends of episodes bit by bit, with noise, commands and resets drawn alike; values, rewards
    with bootstrapped time-outs and returns to float tolerance, because all steps are judged at once. The observation
    stored at t is the one that was acted on. Noise times a power of two is exact: rsl-rl rounds it before it is added.
    """
    scaled = [("train.algorithm.reward_scale", scale), ("train.policy.init_noise_std", 0.5)]
    first, runner = task_and_runner(Runner, *scaled)
    stock = runner.alg
    torch.manual_seed(7)
    first.reset()
    first.episode_length_buf = torch.arange(12) + first.max_episode_length - 6  # some end by time, at different steps
    with torch.inference_mode():
        observations = first.get_observations()
        for _ in range(STEPS):
            observations, rewards, dones, extras = first.step(stock.act(observations))
            stock.process_env_step(observations, rewards, dones, extras)
            learned_from = stock.storage.rewards[stock.storage.step - 1].squeeze(1)
            torch.testing.assert_close(learned_from[~extras["time_outs"]], scale * rewards[~extras["time_outs"]])
        stock.compute_returns(observations)

    second, captured = task_and_runner(CapturedRunner, *scaled)
    torch.manual_seed(7)
    second.reset()
    second.episode_length_buf = torch.arange(12) + second.max_episode_length - 6
    rollout = Rollout(second, captured.alg)
    rollout.collect()
    ours = captured.alg.storage
    assert stock.storage.dones.sum() > 3
    for name in ("actions", "dones"):
        torch.testing.assert_close(getattr(ours, name), getattr(stock.storage, name), rtol=0, atol=0, msg=name)
    for name in ("values", "rewards", "returns", "advantages"):
        torch.testing.assert_close(getattr(ours, name), getattr(stock.storage, name), rtol=1e-5, atol=1e-5, msg=name)
    for name in ("actor", "critic"):
        torch.testing.assert_close(ours.observations[name], stock.storage.observations[name], rtol=0, atol=0)
    torch.testing.assert_close(ours.actions_log_prob, stock.storage.actions_log_prob, rtol=1e-5, atol=1e-5)
    for mine, theirs in zip(ours.distribution_params, stock.storage.distribution_params, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=0)


def test_ended_episodes_are_counted_over_rollouts():
    """Two episodes end by time in the second rollout, after 8 + 3 and 8 + 5 steps. With a value function that is 0 nothing is
    added to rewards for that, so their returns are the sums of the stored rewards of those steps.
    """
    task, runner = task_and_runner(CapturedRunner, num_envs=2)
    with torch.no_grad():
        for parameter in runner.alg.critic.parameters():
            parameter.zero_()
    task.reset()
    rollout = Rollout(task, runner.alg)
    rewards = runner.alg.storage.rewards  # (T, N, 1)
    rollout.collect()
    assert rollout.ended.tolist() == [0.0, 0.0, 0.0, 0.0]
    first = rewards.sum(dim=0).flatten()
    torch.testing.assert_close(rollout.episodes["return"], first)
    task.episode_length_buf = task.max_episode_length - torch.tensor([3, 5])
    rollout.collect()
    ended, returns, lengths, squares = rollout.ended.tolist()
    assert (ended, lengths) == (2.0, 24.0)
    of_each = first + torch.stack([rewards[:3, 0].sum(), rewards[:5, 1].sum()])
    assert returns == pytest.approx(float(of_each.sum()), rel=1e-5)
    assert squares == pytest.approx(0.5 * float(of_each[0] - of_each[1]) ** 2, rel=1e-3)
    assert rollout.episodes["length"].tolist() == [5.0, 3.0]
    torch.testing.assert_close(rollout.episodes["return"], torch.cat([rewards[3:, 0].sum(0), rewards[5:, 1].sum(0)]))


@pytest.mark.slow
def test_nothing_in_an_iteration_reads_on_the_host():
    task, runner = task_and_runner(CapturedRunner)
    rollout = Rollout(task, runner.alg)
    with ForbidHostReads():
        rollout.collect()
        runner.alg.learn()


def test_the_learning_rate_is_changed_in_place():
    alg = learner(DevicePPO)
    address = alg.optimizer.param_groups[0]["lr"].data_ptr()
    fill(alg, 0)
    alg.update()
    assert alg.learning_rate != pytest.approx(1e-3)
    assert alg.optimizer.param_groups[0]["lr"].data_ptr() == address
    alg.learning_rate = 3e-4
    assert alg.learning_rate == pytest.approx(3e-4)
    assert float(alg.optimizer.param_groups[0]["lr"]) == pytest.approx(3e-4)


def test_normalisers_are_updated_in_place():
    """A captured rollout reads them where they were when it was captured."""
    alg = learner(DevicePPO, normalized=True)
    before = {name: tensor.data_ptr() for name, tensor in alg.actor.obs_normalizer.state_dict().items()}
    fill(alg, 0)
    alg.update()
    after = alg.actor.obs_normalizer.state_dict()
    assert {name: tensor.data_ptr() for name, tensor in after.items()} == before
    assert int(after["count"]) == SAMPLES
    assert after["_mean"].abs().max() > 0.0


def test_what_needs_rsl_rls_update_is_named():
    alg = learner(DevicePPO, symmetry_cfg={**MIRROR, "use_mirror_loss": True})
    assert alg.why_stock == "mirror_loss_coeff is above 0"
    assert learner(DevicePPO, optimizer="sgd").why_stock == "the optimiser is SGD"
    fill(alg, 0)
    assert set(alg.update()) == {"value", "surrogate", "entropy", "symmetry"}  # by rsl-rl's own


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [("stock", "captured"), ("captured", "stock"), ("captured", "captured")])
def test_checkpoints_are_exchanged_between_the_loops(first, second):
    """A run begun with one loop goes on with the other: counts of optimiser steps and the learning rate continue."""
    begun = tiny_run("--runner", first, "train.algorithm.learning_rate=2e-4")
    resumed = tiny_run("--runner", second, "--resume", iterations=3)
    before, after = (torch.load(run / f"model_{i}.pt", weights_only=True) for run, i in ((begun, 1), (resumed, 2)))
    assert checkpoints(resumed) == [2]
    steps = [{int(s["step"]) for s in saved["optimizer_state_dict"]["state"].values()} for saved in (before, after)]
    assert steps == [{40}, {60}]
    for saved in (before, after):
        (group,) = saved["optimizer_state_dict"]["param_groups"]
        assert isinstance(group["lr"], float)
        assert group["lr"] == pytest.approx(saved["infos"]["learning_rate"])
        assert not group["capturable"]


@pytest.mark.slow
def test_both_loops_log_the_same_things():
    tags = {}
    for loop in ("stock", "captured"):
        folder: Path = tiny_run("--runner", loop, "env.episode_length_s=0.1")
        tags[loop] = set(read_scalars(folder))
    assert tags["stock"] == tags["captured"]
    assert {"Train/mean_reward", "Train/std_reward", "Loss/value", "Loss/kl", "Metrics/falls", "Perf/learning_time"} <= tags[
        "captured"
    ]


@pytest.mark.slow
def test_the_captured_loop_stops_when_asked():
    task = small_task(num_envs=4)
    runner = CapturedRunner(task, Path("run"), "cpu")
    Path("run").mkdir()
    runner.stop()
    assert not runner.train(5)
    assert checkpoints(Path("run")) == [0]


@pytest.mark.slow
@pytest.mark.parametrize(("loop", "learns"), [("stock", PPO), ("captured", DevicePPO)])
def test_the_loop_is_a_setting(loop, learns, monkeypatch):
    """Training runs on the loop that the configuration names, whichever the flag or the default is."""
    built = []
    construct = learns.construct_algorithm
    monkeypatch.setattr(learns, "construct_algorithm", staticmethod(lambda *a: built.append(construct(*a)) or built[-1]))
    folder = tiny_run(f"train.runner.loop={loop}")
    assert run_config(folder).train.runner.loop == loop
    assert [type(alg) for alg in built] == [learns]


def test_laps_are_timed(monkeypatch):
    """On the CPU, by its clock: 3 s, then 0.5 s."""
    now = iter([10.0, 13.0, 13.5])
    monkeypatch.setattr(captured_module.time, "perf_counter", lambda: next(now))
    clock = Clock(torch.device("cpu"))
    clock.lap()
    clock.lap()
    assert clock.seconds() == [3.0, 0.5]


def test_a_clock_that_follows_another_counts_what_was_done_between_them(monkeypatch):
    now = iter([10.0, 13.0, 17.0, 18.0])
    monkeypatch.setattr(captured_module.time, "perf_counter", lambda: next(now))
    before = Clock(torch.device("cpu"))
    before.lap()
    after = Clock(torch.device("cpu"), before)
    after.lap()
    after.lap()
    assert (before.seconds(), after.seconds()) == ([3.0], [4.0, 1.0])


def test_a_snapshot_leaves_no_gradient_node_alive():
    # It is taken on one CUDA stream and the update captured on another; see captured.copies.
    parameter = torch.nn.Parameter(torch.ones(3))
    (snapshot,) = copies([parameter])
    assert snapshot.grad_fn is None
    with torch.no_grad():
        parameter += 1.0
    assert snapshot.tolist() == [1.0, 1.0, 1.0]
