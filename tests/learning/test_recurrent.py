"""Recurrent policies: configured, trained, resumed, played and exported; their memory ends with an episode."""

import json
import re

import numpy as np
import onnxruntime
import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, checkpoints, run_folders, small_config, small_task, tiny_run

import legged.policies.export as export_module
from legged.cli.play import play
from legged.cli.train import train
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.run_folder import run_config
from legged.learning.runner import Runner
from legged.policies.actor import Actor
from legged.policies.export import ExportError, export
from legged.policies.restore import policy_of, restore
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")


def recurrent(kind: str, layers: int = 2) -> list[tuple[str, object]]:
    return [
        ("train.policy.rnn_type", kind),
        ("train.policy.rnn_hidden_dim", 6),
        ("train.policy.rnn_num_layers", layers),
        ("train.policy.actor_hidden_dims", [8]),
        ("train.policy.critic_hidden_dims", [8]),
        ("train.algorithm.symmetry", False),
    ]


def flags(kind: str) -> list[str]:
    return [f"{key}={str(value).lower()}" for key, value in recurrent(kind)] + ["train.algorithm.num_mini_batches=2"]


# ---- training, resuming, playing -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_a_recurrent_policy_is_trained_resumed_played_and_exported(kind, capsys):
    folder = tiny_run(*flags(kind))
    saved = read_checkpoint(folder / "model_1.pt")
    for network in saved["infos"]["networks"].values():
        assert (network["rnn_type"], network["rnn_hidden_dim"], network["rnn_num_layers"]) == (kind, 6, 2)
    assert run_config(folder).train.policy.rnn_type == kind

    resumed = tiny_run(*flags(kind), "--resume", "--load_run", str(folder), iterations=3)
    assert max(checkpoints(resumed)) == 2

    out = [
        "--task",
        TASK,
        "--sim_device",
        "cpu",
        "--no-video",
        "--load_run",
        str(folder),
        "--num_envs",
        "1",
    ]  # less than mini-batches
    assert call(play.main, out) == 0  # with fewer robots than mini-batches
    assert "policy.onnx, largest difference" in capsys.readouterr().out
    told = json.loads((folder / "exported" / "policy.json").read_text())["recurrent"]
    assert told["rnn_type"] == kind
    assert told["shape"] == [2, "batch", 6]
    assert told["onnx_inputs"] == (["h_in", "c_in"] if kind == "lstm" else ["h_in"])


@pytest.mark.slow
def test_training_says_that_rsl_rls_loop_runs_and_why(capsys):
    arguments = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "1"]
    assert call(train.main, [*arguments, *TINY_TRAINING, *flags("gru")]) == 0
    assert "rsl-rl's own training loop: the actor is a RNNModel" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("robots", "mini_batches"), [(4, 2), (4, 4), (1, 1)])
def test_each_step_of_a_mini_batch_is_weighed_by_its_own_advantage_and_no_other_one(robots, mini_batches):
    """While the policy stands still the ratio of probabilities is 1, and the loss minus the mean advantage."""
    learning = [("train.algorithm.num_mini_batches", mini_batches), ("train.algorithm.num_learning_epochs", 1)]
    still = [("train.algorithm.learning_rate", 1e-12), ("train.algorithm.schedule", "fixed")]
    steps = [("train.runner.num_steps_per_env", 6)]
    task = small_task(*recurrent("gru"), *learning, *still, *steps, num_envs=robots)
    algorithm = Runner(task).alg
    algorithm.train_mode()
    observations = task.get_observations()
    with torch.inference_mode():
        for _ in range(6):
            observations, rewards, dones, extras = task.step(algorithm.act(observations))
            algorithm.process_env_step(observations, rewards, dones, extras)
        algorithm.compute_returns(observations)
        algorithm.storage.advantages[:] = torch.arange(6.0).view(6, 1, 1)
    assert algorithm.update()["surrogate"] == pytest.approx(-2.5, rel=1e-4)


# ---- configuration -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            "train.algorithm.symmetry=true",
            r"train\.algorithm\.symmetry: .*lstm.* mirror images; set train\.algorithm\.symmetry=false",
        ),
        ("train.algorithm.num_mini_batches=9", r"num_mini_batches: .*at most env\.num_envs=8.* got 9"),
        ("train.policy.rnn_type=lsmt", r"train\.policy\.rnn_type: .*lstm"),
        ("train.policy.rnn_hidden_dim=0", r"train\.policy\.rnn_hidden_dim: "),
        ("train.policy.rnn_num_layers=0", r"train\.policy\.rnn_num_layers: "),
    ],
)
def test_what_does_not_go_together_is_refused_at_start_up(change, text, capsys):
    arguments = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", *flags("lstm"), change]
    assert call(train.main, arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(text, error), error
    assert run_folders() == []


def test_symmetry_of_the_shipped_task_is_named_with_its_file(capsys):
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", "train.policy.rnn_type=gru"]) == 2
    error = capsys.readouterr().err
    assert "train.algorithm.symmetry" in error
    assert "train.policy.rnn_type=gru, command line" in error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trained", "asked", "text"),
    [
        ("lstm", "gru", "its actor has rnn_type lstm, the configuration has train.policy.rnn_type gru"),
        ("gru", "none", "its actor has rnn_type gru, the configuration has train.policy.rnn_type none"),
        ("none", "lstm", "its actor has rnn_type none, the configuration has train.policy.rnn_type lstm"),
    ],
)
def test_a_checkpoint_of_another_kind_is_refused(trained, asked, text, tmp_path):
    path = tmp_path / "model_0.pt"
    Runner(small_task(*recurrent(trained))).save(str(path))
    with pytest.raises(ConfigError, match=text):
        check_fits(path, read_checkpoint(path), small_config(*recurrent(asked)))


@pytest.mark.slow
def test_a_checkpoint_of_another_width_or_depth_is_refused(tmp_path):
    path = tmp_path / "model_0.pt"
    Runner(small_task(*recurrent("gru"))).save(str(path))
    check_fits(path, read_checkpoint(path), small_config(*recurrent("gru")))
    with pytest.raises(ConfigError, match=r"rnn_num_layers 2, the configuration has train\.policy.rnn_num_layers 3"):
        check_fits(path, read_checkpoint(path), small_config(*recurrent("gru", layers=3)))
    with pytest.raises(ConfigError, match=r"rnn_hidden_dim 6, the configuration has train\.policy.rnn_hidden_dim 7"):
        check_fits(path, read_checkpoint(path), small_config(*recurrent("gru"), ("train.policy.rnn_hidden_dim", 7)))


# ---- memory --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lstm", "gru"])
@pytest.mark.parametrize("inference", [True, False])
def test_who_begins_an_episode_acts_as_if_nothing_had_been(kind, inference):
    task = small_task(*recurrent(kind))
    act = Actor(task, "cpu")
    policy = act.network
    torch.manual_seed(0)
    first, second = (task.get_observations().apply(torch.randn_like) for _ in range(2))
    task.reset()
    with torch.inference_mode(inference), torch.no_grad():
        act(first)
        task.reset_buf.copy_(torch.tensor([False, True, False, True]))
        found = act(second)
    with torch.no_grad():
        policy.reset()
        fresh = policy(second)
        policy.reset()
        policy(first)
        remembered = policy(second)
    assert (fresh - remembered).abs().max() > 1e-4
    assert torch.allclose(found[[1, 3]], fresh[[1, 3]], atol=1e-6)
    assert torch.allclose(found[[0, 2]], remembered[[0, 2]], atol=1e-6)
    with torch.no_grad():  # and the mode may change from call to call
        assert torch.isfinite(act(first)).all()
        task.reset()
        assert torch.allclose(act(second), fresh, atol=1e-6)


@pytest.mark.slow
def test_a_restored_policy_forgets(tmp_path):
    folder = tiny_run(*flags("lstm"))
    task, act = restore(policy_of(str(folder)), [("env.num_envs", 3)], torch.device("cpu"))
    observations = task.reset()
    with torch.inference_mode():
        before = act(observations)
        for _ in range(3):
            observations, _, _, _ = task.step(act(observations))
        task.reset_buf.fill_(True)
        start = task.get_observations().apply(torch.zeros_like)
        again = act(start)
        act.network.reset()
        assert torch.allclose(act.network(start), again, atol=1e-6)
    assert before.shape == (3, 12)


# ---- export --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_exports_compute_the_policy_over_a_sequence(kind, tmp_path):
    task = small_task(*recurrent(kind))
    runner = Runner(task)
    policy = runner.alg.get_policy()
    act = runner.get_inference_policy("cpu")
    with torch.no_grad():
        for parameter in policy.rnn.parameters():
            parameter.mul_(3.0)  # so that the past matters
        act(task.get_observations())
    kept = policy.get_hidden_state()
    differences = export(runner.env, runner.alg.get_policy(), tmp_path)
    assert policy.get_hidden_state() is kept, "an export must not touch what the robots remember"
    assert all(value < 1e-5 for value in differences.values())

    torch.manual_seed(1)
    steps = [task.get_observations().apply(torch.randn_like) for _ in range(20)]
    policy.reset()
    with torch.inference_mode():
        wanted = [act(step) for step in steps]
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    script = torch.jit.load(str(tmp_path / "policy.pt"))
    hidden = {entry.name: np.zeros((2, 4, 6), dtype=np.float32) for entry in session.get_inputs()[1:]}
    assert set(hidden) == ({"h_in", "c_in"} if kind == "lstm" else {"h_in"})
    assert session.get_outputs()[0].name == "actions"
    spread = 0.0
    for step, expected in zip(steps, wanted, strict=True):
        action, *state = session.run(None, {"obs": step["actor"].numpy(), **hidden})
        hidden = dict(zip(hidden, state, strict=True))
        np.testing.assert_allclose(action, expected, rtol=0.0, atol=1e-5)
        with torch.inference_mode():
            np.testing.assert_allclose(script(step["actor"][:1]), expected[:1], rtol=0.0, atol=1e-5)
            spread = max(spread, float((expected - act(step)).abs().max()))
    script.reset()
    with torch.inference_mode():
        np.testing.assert_allclose(script(steps[0]["actor"][:1]), wanted[0][:1], rtol=0.0, atol=1e-5)
    assert spread > 1e-3


@pytest.mark.slow
def test_an_export_that_forgets_is_refused(tmp_path, monkeypatch):
    runner = Runner(small_task(*recurrent("gru")))
    with torch.no_grad():
        for parameter in runner.alg.get_policy().rnn.parameters():
            parameter.mul_(5.0)
    run = export_module._by_onnx

    def forgetful(content, observations, begins, memory):
        return run(content, observations, torch.ones_like(begins), memory)

    monkeypatch.setattr(export_module, "_by_onnx", forgetful)
    with pytest.raises(ExportError, match=r"policy\.onnx: differs"):
        export(runner.env, runner.alg.get_policy(), tmp_path)


@pytest.mark.slow
def test_without_recurrent_layers_nothing_changes():
    cfg = task_config(TASK, [("env.num_envs", 2)], on_cpu=True)
    assert cfg.train.policy.rnn_type == "none"
    assert not Runner(small_task()).alg.get_policy().is_recurrent
