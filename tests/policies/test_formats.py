"""Exports that other programs read: readers written here, from the files alone, do what our policy does."""

from collections import deque

import numpy as np
import onnxruntime
import pytest
import torch
import yaml
from helpers import CALM, ENGINE, call, small_task

from legged.cli.export import export as export_tool
from legged.errors import ConfigError
from legged.learning.runner import Runner
from legged.policies import formats
from legged.policies.export import ExportError, onnx_of
from legged.policies.formats import export_as
from legged.registry import make_task, task_config

SMALL = [
    ("env.num_envs", 2),
    ("train.policy.actor_hidden_dims", [16, 8]),
    ("train.policy.critic_hidden_dims", [8]),
    ("train.algorithm.symmetry", False),
    ("train.algorithm.num_mini_batches", 2),
    ("init_state.yaw", [-3.0, 3.0]),
]
BLIND = ["base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions"]
GO2_MOTORS = [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")]
UNJOINTED = [name for name in BLIND if not name.startswith("dof_")]
ONE_FRAME = [("observations.groups.actor.terms", BLIND)]


def trained(name, *changes):
    """A task, and its policy: a fresh one with larger actions, whose statistics of observations are not trivial."""
    torch.set_num_threads(1)
    torch.manual_seed(3)
    task = make_task(task_config(name, [*ENGINE, *CALM, *SMALL, *changes], on_cpu=True))
    runner = Runner(task)
    network = runner.alg.get_policy()
    with torch.no_grad():
        for parameter in network.mlp[-1].parameters():
            parameter.mul_(3.0)
    if network.obs_normalization:
        for _ in range(3):
            observations = task.get_observations()
            network.train()
            network.update_normalization(observations.apply(lambda tensor: tensor + 2.0 * torch.randn_like(tensor)))
    network.eval()
    return task, runner, network


class Reader:
    """A policy for one robot, run by a program that knows nothing but the file."""

    def __init__(self, path):
        self.session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        self.metadata = self.session.get_modelmeta().custom_metadata_map
        self.restart()

    def restart(self):
        self.past, self.last = {}, np.zeros(len(self.joints))

    def act(self, measured):
        """Targets by joint. `measured` has angles and speeds by joint, and the robot's other measurements by our names."""
        angles, speeds = (np.array([measured[what][name] for name in self.joints]) for what in ("angles", "speeds"))
        values = {**measured, "position": angles - self.pose, "speed": speeds, "last": self.last}
        columns = []
        for name, scale, length in self.terms:
            value = scale * values[self.NAMES[name]]
            frames = self.past.setdefault(name, deque([value] * int(length), maxlen=int(length)))
            frames.append(value)
            columns.extend(frames)
        columns = np.concatenate(columns)[None].astype(np.float32)
        self.last = self.session.run(None, {self.session.get_inputs()[0].name: columns})[0][0].astype(float)
        return dict(zip(self.joints, self.offset + self.scale * self.last, strict=True))


class MjlabReader(Reader):
    NAMES = {
        "base_lin_vel": "velocity",
        "base_ang_vel": "gyro",
        "projected_gravity": "gravity",
        "command": "command",
        "joint_pos": "position",
        "joint_vel": "speed",
        "actions": "last",
    }

    @property
    def joints(self):
        return self.metadata["joint_names"].split(",")

    def numbers(self, key):
        return np.array([float(text) for text in self.metadata[key].split(",")])

    def restart(self):
        super().restart()
        self.pose = self.offset = self.numbers("default_joint_pos")
        self.scale = self.numbers("action_scale")
        self.gains = self.numbers("joint_stiffness"), self.numbers("joint_damping")
        names, lengths = self.metadata["observation_names"].split(","), self.numbers("observation_terms_history_length")
        self.terms = list(
            zip(names, self.numbers("observation_terms_scale"), np.maximum(1, lengths.astype(int)), strict=True)
        )


class UnitreeReader(Reader):
    NAMES = {
        "base_ang_vel": "gyro",
        "projected_gravity": "gravity",
        "velocity_commands": "command",
        "joint_pos_rel": "position",
        "joint_vel_rel": "speed",
        "last_action": "last",
    }

    def __init__(self, folder, motors):
        said = yaml.safe_load((folder / "deploy.yaml").read_text())
        self.joints = [motors[i] for i in said["joint_ids_map"]]
        self.gains = np.array([[said[key][i] for i in said["joint_ids_map"]] for key in ("stiffness", "damping")])
        self.pose = np.array(said["default_joint_pos"])
        (action,) = said["actions"].values()
        self.scale, self.offset = np.array(action["scale"]), np.array(action["offset"])
        assert action["clip"] is None
        self.terms = [(name, entry["scale"], entry["history_length"]) for name, entry in said["observations"].items()]
        self.said = said
        super().__init__(folder / "policy.onnx")


def measured_in(task, robot, command):
    """The sensors of one robot of a task, computed from the state of its physics engine."""
    qpos, qvel = (tensor[robot].double().numpy() for tensor in (task.physics._qpos, task.physics._qvel))
    w, x, y, z = qpos[3:7]
    return {
        "angles": dict(zip(task.robot.joint_names, qpos[7:], strict=True)),
        "speeds": dict(zip(task.robot.joint_names, qvel[6:], strict=True)),
        "gyro": qvel[3:6],
        "gravity": np.array([2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1]),
        "velocity": task.base_lin_vel[robot].double().numpy(),
        "command": command,
    }


def walk_along(task, runner, network, readers):
    """Step 100 times: each reader, one for each robot, must ask for the targets of our policy to 1e-5 rad."""
    act = runner.get_inference_policy("cpu")
    task.reset()
    commands = torch.tensor([[0.5, 0.2, -0.3], [-0.4, 0.0, 0.8]])
    observations = task.hold_commands(commands)
    network.reset()
    places, largest = [task.robot.joint_names.index(name) for name in readers[0].joints], 0.0
    for _ in range(100):
        with torch.inference_mode():
            actions = act(observations)
        task.control.set_actions(actions.clip(-task.cfg.control.clip_actions, task.cfg.control.clip_actions))
        for robot, reader in enumerate(readers):
            targets = reader.act(measured_in(task, robot, commands[robot].double().numpy()))
            np.testing.assert_allclose([*targets.values()], task.control._target[robot][places], rtol=0.0, atol=1e-5)
        largest = max(largest, float(actions.abs().max()))
        observations, _, dones, _ = task.step(actions)
        for robot in dones.nonzero().flatten().tolist():
            readers[robot].restart()
    assert largest > 0.2
    for key, values in zip(("p_gain", "d_gain"), readers[0].gains, strict=True):
        np.testing.assert_allclose(values, task.control.nominal[key][places], rtol=0.0, atol=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("anymal_c_flat", [("train.policy.obs_normalization", True), ("control.action_scale", 0.43857)]),
        ("anymal_c_flat", [*ONE_FRAME, ("observations.groups.actor.history", 6)]),
        ("g1_flat", [("observations.clip", 0.3), ("control.clip_actions", 0.25)]),
        ("anymal_c_flat", [("control.held", ["HFE"]), ("observations.groups.actor.terms", UNJOINTED)]),
    ],
    ids=["normalised", "history", "G1, clipped", "held joints"],
)
def test_a_reader_of_mjlabs_metadata_does_what_the_policy_does(name, changes, tmp_path):
    task, runner, network = trained(name, *changes)
    assert export_as(task, network, tmp_path, "mjlab", "logs/a/run") < 1e-5
    assert {path.name for path in tmp_path.iterdir()} == {"policy.onnx"}
    walk_along(task, runner, network, [MjlabReader(tmp_path / "policy.onnx") for _ in range(2)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "motors"),
    [
        ("go2_flat", [*ONE_FRAME, ("observations.groups.actor.history", 3), ("control.action_scale", 0.1234)], GO2_MOTORS),
        ("g1_flat", ONE_FRAME, None),
        ("g1_flat", [("control.held", ["shoulder", "elbow", "wrist"]), ("observations.groups.actor.terms", UNJOINTED)], None),
    ],
    ids=["Go2, history", "G1", "G1, 15 actions"],
)
def test_a_reader_of_deploy_yaml_does_what_the_policy_does(name, changes, motors, tmp_path):
    task, runner, network = trained(name, *changes)
    export_as(task, network, tmp_path, "unitree")
    readers = [UnitreeReader(tmp_path, motors or task.robot.joint_names) for _ in range(2)]
    assert readers[0].said["joint_ids_map"] == list(range(task.num_actions))
    assert len(readers[0].said["stiffness"]) == len(readers[0].said["damping"]) == task.robot.num_dof
    assert readers[0].said["step_dt"] == pytest.approx(0.02)
    low, high = task.command_sampler.full_ranges[0].tolist()
    assert readers[0].said["commands"]["base_velocity"]["ranges"]["lin_vel_x"] == pytest.approx([low, high], abs=5e-4)
    walk_along(task, runner, network, readers)
    # The ONNX file alone says the same.
    walk_along(task, runner, network, [MjlabReader(tmp_path / "policy.onnx") for _ in range(2)])


@pytest.mark.slow
def test_the_metadata_have_mjlabs_keys_and_numbers(tmp_path):
    task, _, network = trained("anymal_c_flat", *ONE_FRAME, ("observations.groups.actor.history", 2))
    export_as(task, network, tmp_path, "mjlab")
    said = MjlabReader(tmp_path / "policy.onnx").metadata
    assert said["run_path"] == "none"
    assert said["joint_names"].startswith("LF_HAA,LF_HFE,LF_KFE,RF_HAA")
    assert said["joint_stiffness"] == ",".join(["90.000"] * 12)
    assert said["joint_damping"] == ",".join(["4.000"] * 12)
    assert said["default_joint_pos"].startswith("0.000,0.400,-0.800,0.000")
    assert said["action_scale"] == ",".join(["0.500"] * 12)
    assert said["command_names"] == "twist"
    assert said["observation_names"] == "base_ang_vel,projected_gravity,command,joint_pos,joint_vel,actions"
    assert said["observation_terms_scale"] == "1.000,1.000,1.000,1.000,1.000,1.000"
    assert said["observation_terms_history_length"] == "2.000,2.000,2.000,2.000,2.000,2.000"
    assert said["observation_terms_flatten_history_dim"] == "1.000,1.000,1.000,1.000,1.000,1.000"
    assert said["observation_terms_clip"] == ",".join(["-inf;inf"] * 6)
    assert said["fps"] == "50"
    (entry,) = onnxruntime.InferenceSession(tmp_path / "policy.onnx").get_inputs()
    assert (entry.name, entry.shape) == ("obs", [1, 90])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "form", "changes", "says"),
    [
        (
            "anymal_c_flat",
            "mjlab",
            [("control.held", ["HAA"])],
            r"control\.held: --format mjlab knows only joints with an action, but 'dof_pos' has 12 numbers for 8 act",
        ),
        (
            "anymal_c_flat",
            "mjlab",
            [("train.policy.rnn_type", "gru"), ("train.policy.rnn_hidden_dim", 8)],
            r"train\.policy\.rnn_type: --format mjlab has no hidden state, got 'gru'",
        ),
        (
            "anymal_c_flat",
            "mjlab",
            [("observations.groups.actor.terms", [*BLIND, "heights"])],
            r"observations\.groups\.actor: --format mjlab cannot express 'heights' of 187 numbers",
        ),
        ("go2_flat", "unitree", [], r"observations\.groups\.actor: --format unitree cannot express 'base_lin_vel'"),
        (
            "anymal_c_flat",
            "unitree",
            ONE_FRAME,
            r"robot: --format unitree numbers the motors of .*\(go2, g1\), got 'anymal_c'",
        ),
        ("go2w_flat", "mjlab", [], r"control\.control_type: --format mjlab knows joint position targets only"),
        ("half_cheetah", "mjlab", None, r"task: --format mjlab is for policies that follow velocity commands, got"),
    ],
)
def test_what_a_format_cannot_express_is_refused_by_the_setting(name, form, changes, says, tmp_path):
    small = SMALL[:-1] if changes is not None else [SMALL[0], SMALL[4]]
    task = make_task(task_config(name, [*ENGINE, *small, *(changes or ())], on_cpu=True))
    with pytest.raises(ConfigError, match=says):
        export_as(task, None, tmp_path / "exported", form)
    assert not (tmp_path / "exported").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("workplace")
def test_the_command_writes_a_folder_for_each_format(tmp_path, capsys):
    assert call(export_tool.main, ["go2_real", "--format", "unitree"]) == 0
    (folder,) = (tmp_path / "logs" / "export" / "go2_real" / "exported_unitree").iterdir()
    assert {path.name for path in folder.iterdir()} == {"policy.onnx", "deploy.yaml"}
    assert call(export_tool.main, ["g1_flat", "--format", "unitree", "--out", "out"]) == 2
    assert "cannot express 'base_lin_vel'" in capsys.readouterr().err


def test_a_file_that_computes_something_else_is_refused(tmp_path, monkeypatch):
    task = small_task(*SMALL[1:3])
    monkeypatch.setattr(formats, "onnx_of", lambda network, *rest, **more: onnx_of(Other(network), *rest, **more))
    with pytest.raises(ExportError, match=r"policy\.onnx: differs from the policy by"):
        export_as(task, Runner(task).alg.get_policy(), tmp_path, "mjlab")
    assert not list(tmp_path.iterdir())


class Other(torch.nn.Module):
    """A network with other actions."""

    input_names, output_names = ("obs",), ("actions",)

    def __init__(self, network):
        super().__init__()
        self.network, self.get_dummy_inputs = network, network.get_dummy_inputs

    def forward(self, obs):
        return self.network(obs) + 0.5

    def as_onnx(self, verbose):
        return self
