"""Exported policies compute what the policy does, and say what a controller must know."""

import hashlib
import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from helpers import TINY_TRAINING, call, run_folders, small_task

import legged.policies.export as export_module
from legged.cli.export import export as export_tool
from legged.cli.train import train
from legged.learning.runner import Runner
from legged.policies.export import ExportError, export


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "normalised"])
def runner(request):
    """An untrained policy; with observation normalisation its statistics are not those of a fresh network."""
    sizes = [("train.policy.actor_hidden_dims", [16, 8]), ("train.policy.critic_hidden_dims", [8])]
    runner = Runner(small_task(*sizes, ("train.policy.obs_normalization", request.param)))
    if request.param:
        torch.manual_seed(0)
        observations = runner.env.get_observations()
        runner.alg.get_policy().train()
        for _ in range(3):
            noisy = observations.apply(lambda tensor: tensor + torch.randn_like(tensor) * 3.0 + 1.0)
            runner.alg.get_policy().update_normalization(noisy)
    return runner


@pytest.fixture(scope="module")
def exported(runner, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    return folder, export(runner.env, runner.alg.get_policy(), folder)


@pytest.fixture(scope="module")
def cases(runner):
    """Random observations and the policy's own actions for them, through rsl-rl."""
    torch.manual_seed(1)
    observations = torch.randn(1000, 48) * 2.0
    groups = runner.env.get_observations().new_zeros(1000)
    groups["actor"] = observations
    groups["critic"] = observations
    with torch.inference_mode():
        return observations, runner.get_inference_policy("cpu")(groups)


@pytest.mark.slow
def test_torchscript_computes_the_policy(exported, cases):
    observations, actions = cases
    script = torch.jit.load(str(exported[0] / "policy.pt"))
    assert actions.shape == (1000, 12)
    assert actions.std() > 0.01
    assert (script(observations) - actions).abs().max() < 1e-5


@pytest.mark.slow
def test_onnx_computes_the_policy_for_any_batch_size(exported, cases):
    observations, actions = cases
    session = onnxruntime.InferenceSession(str(exported[0] / "policy.onnx"), providers=["CPUExecutionProvider"])
    for size in (1, 7, 1000):
        (found,) = session.run(["actions"], {"obs": observations[:size].numpy()})
        assert np.abs(found - actions[:size].numpy()).max() < 1e-5


def test_the_reported_differences_are_small_and_nothing_half_written_is_left(exported):
    folder, differences = exported
    assert set(differences) == {"policy.pt", "policy.onnx", "policy.weights"}
    assert all(0.0 <= value < 1e-5 for value in differences.values())
    assert {path.name for path in folder.iterdir()} == {"policy.pt", "policy.onnx", "policy.weights", "policy.json"}


def test_the_metadata_says_what_a_controller_must_know(exported, runner):
    model = onnx.load(str(exported[0] / "policy.onnx"))
    metadata = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    described = json.loads((exported[0] / "policy.json").read_text())
    for name, digest in described.pop("sha256").items():
        assert digest == hashlib.sha256((exported[0] / name).read_bytes()).hexdigest(), name
    assert metadata == described
    layout = [(term["name"], term["start"], term["size"]) for term in metadata["observation"]]
    assert layout == [
        ("base_lin_vel", 0, 3),
        ("base_ang_vel", 3, 3),
        ("projected_gravity", 6, 3),
        ("commands", 9, 3),
        ("dof_pos", 12, 12),
        ("dof_vel", 24, 12),
        ("actions", 36, 12),
    ]
    scales = {term["name"]: term["scale"] for term in metadata["observation"]}
    assert scales["commands"] == [2.0, 2.0, 0.25]
    assert scales["base_lin_vel"] == [2.0] * 3
    assert scales["dof_vel"] == pytest.approx([0.05] * 12)
    assert metadata["joint_names"] == [
        f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE")
    ]
    front, hind = [0.0, 0.4, -0.8], [0.0, -0.4, 0.8]
    assert metadata["default_joint_angles"] == pytest.approx([*front, *front, *hind, *hind])
    gains = runner.env.robot.file
    assert metadata["stiffness"] == pytest.approx([gains.stiffness[j] for j in ("HAA", "HFE", "KFE")] * 4)
    assert metadata["damping"] == pytest.approx([gains.damping[j] for j in ("HAA", "HFE", "KFE")] * 4)
    assert metadata["torque_limits"] == [80.0] * 12
    assert metadata["action_scale"] == 0.5
    assert metadata["action_clip"] == 100.0
    assert metadata["observation_clip"] == 100.0
    assert metadata["control_type"] == "P"
    assert metadata["control_dt"] == pytest.approx(0.02)
    assert (metadata["task"], metadata["robot"]) == ("anymal_c_flat", "anymal_c")


@pytest.mark.slow
@pytest.mark.parametrize("file", ["policy.pt", "policy.onnx", "policy.weights"])
def test_an_export_that_computes_something_else_is_refused_by_name(runner, tmp_path, monkeypatch, file):
    function = {"policy.pt": "_torchscript", "policy.onnx": "onnx_of", "policy.weights": "weights_of"}[file]
    write = getattr(export_module, function)

    def write_another(policy, *rest):
        parameter = list(policy.parameters())[-1]  # the biases of the last layer
        with torch.no_grad():
            kept = parameter.clone()
            parameter.add_(0.5)
            try:
                return write(policy, *rest)
            finally:
                parameter.copy_(kept)

    monkeypatch.setattr(export_module, function, write_another)
    with pytest.raises(ExportError, match=rf"{file}: differs from the policy by"):
        export(runner.env, runner.alg.get_policy(), tmp_path)
    assert not list(tmp_path.iterdir()), "a refused export must not look like one that passed"


def test_an_export_that_gives_nan_is_refused(runner, tmp_path, monkeypatch):
    class Session:
        def __init__(self, *_args, **_kwargs):
            pass

        def run(self, _names, inputs):
            return (np.full((len(inputs["obs"]), 12), np.nan),)

    monkeypatch.setattr(export_module.onnxruntime, "InferenceSession", Session)
    with pytest.raises(ExportError, match=r"policy\.onnx"):
        export(runner.env, runner.alg.get_policy(), tmp_path)
    assert not (tmp_path / "policy.json").exists()


@pytest.mark.slow
def test_a_policy_of_large_actions_may_differ_by_their_share(tmp_path):
    """float32 has seven digits: of actions of 2e6 the last one is 0.1, which is no fault of an export."""
    sizes = [("train.policy.actor_hidden_dims", [128, 64, 32]), ("train.policy.critic_hidden_dims", [8])]
    runner = Runner(small_task(*sizes))
    with torch.no_grad():
        for parameter in runner.alg.get_policy().mlp.parameters():
            parameter.mul_(100.0)
        assert runner.alg.get_policy()(runner.env.get_observations()).abs().max() > 1e5
    assert max(export(runner.env, runner.alg.get_policy(), tmp_path / "exported").values()) < 1e-4


@pytest.mark.usefixtures("workplace")
def test_all_checkpoints_of_a_task_without_commands_are_exported():
    """It has neither pushes nor a base to draw a mass for, so there is nothing to switch off."""
    flags = ["--task", "half_cheetah", "--num_envs", "4", "--max_iterations", "2", "train.runner.save_interval=1"]
    assert call(train.main, [*flags, *TINY_TRAINING, "--sim_device", "cpu", "train.algorithm.num_mini_batches=1"]) == 0
    assert call(export_tool.main, ["half_cheetah"]) == 0
    (folder,) = run_folders()
    for name in ("00001", "00002"):
        policy = torch.jit.load(str(folder / "exported" / name / "policy.pt"))
        assert policy(torch.zeros(1, 17)).shape == (1, 6)
